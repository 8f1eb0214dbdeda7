"""Drawing with OpenCV: frames with marks on them, charts, and sheets of both. Nothing is computed here but where things stand."""

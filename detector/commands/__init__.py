"""The commands of ``detector``, a module each: ``add`` describes its options and names the function that runs it."""

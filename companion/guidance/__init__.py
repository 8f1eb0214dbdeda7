"""Pure decisions: setpoints, frames of reference, poses, and the switch S. No I/O."""

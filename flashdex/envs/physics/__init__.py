"""Physics engines behind one protocol: state in, control step, state out."""

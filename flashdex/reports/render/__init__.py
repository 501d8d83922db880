"""Pictures and films, drawn in a process of their own."""

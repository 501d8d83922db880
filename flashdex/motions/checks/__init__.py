"""What a recording or a prepared motion must hold, and what is found."""

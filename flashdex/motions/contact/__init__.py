"""Which hand does what with which object, and what the objects rest on."""

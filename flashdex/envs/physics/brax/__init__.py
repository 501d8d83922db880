"""MJX on JAX, through brax."""

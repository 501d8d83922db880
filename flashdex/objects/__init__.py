"""A mesh becomes an asset: convex parts, distance grid, points, inertia, symmetry."""

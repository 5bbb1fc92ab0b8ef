"""Number types of the kernels: lanes, vectors, matrices, rotations, and random numbers."""

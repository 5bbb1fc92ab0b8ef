"""Elementary functions, small linear algebra, rotations and random numbers. Imports simd."""

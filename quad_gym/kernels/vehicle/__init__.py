"""The quadrotor, the air around it and its inner control loops. Imports maths."""

"""What stands in the way: shapes, contact and lines of sight. Imports maths."""

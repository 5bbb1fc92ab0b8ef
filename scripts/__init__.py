"""Programs of a clone: to read and copy, and for the results of the documentation."""

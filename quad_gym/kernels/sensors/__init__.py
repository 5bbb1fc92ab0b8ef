"""What the sensors measure, and the faults that corrupt it. Imports maths and vehicle."""

"""Number types of the kernels: lanes, bits, records of several flights. Imports records."""

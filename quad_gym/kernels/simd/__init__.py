"""The number types of the kernels: lanes, bits and records of several flights. Imports records only."""

"""The numbers of a sensor suite, and of a vehicle, from logs."""

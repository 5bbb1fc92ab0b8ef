"""`FlightBatch`: owns the records of many flights; threads, starts and warm starts."""

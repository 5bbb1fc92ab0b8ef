"""The compiled core: everything in a flight is computed here."""

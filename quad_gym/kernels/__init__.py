"""The compiled core: every number that flies is computed here."""

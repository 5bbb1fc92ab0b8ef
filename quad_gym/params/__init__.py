"""Parameters: frozen dataclasses with units, checks, sources and presets; they import no kernel."""

"""Controllers to compare against."""

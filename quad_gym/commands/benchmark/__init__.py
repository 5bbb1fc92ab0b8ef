"""The benchmark, a module for each section; `main` runs them."""

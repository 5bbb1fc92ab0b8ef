"""A page on which one flies in the browser: sources, and the script that bundles them."""

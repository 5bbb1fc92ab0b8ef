"""The commands of `quad-gym`, a module each; a file in `scripts/` runs the same."""

"""The commands of `quad-gym`, a module each."""

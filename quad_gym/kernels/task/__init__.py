"""Episodes: starts, references, rewards, observations, draws. Imports all rooms below."""

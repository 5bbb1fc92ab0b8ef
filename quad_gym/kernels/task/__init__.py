"""Episodes: starts, references, rewards, observations, draws. Imports all packages below."""

"""Coverage-guided fuzzing of all that reads untrusted bytes (docs/reliability.md)."""

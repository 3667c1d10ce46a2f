"""The window to fly in, and pictures for commands and notebooks."""

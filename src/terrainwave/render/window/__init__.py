"""The window to fly in, and pictures as commands and notebooks ask for them."""

"""Entropy coder and filters shared by the codec and the triangulation."""

"""Refiners: how one group of heights becomes a payload and comes back."""

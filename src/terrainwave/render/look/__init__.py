"""Appearance of pictures: colours, water, orthophotos, overlays."""

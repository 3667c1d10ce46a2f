"""What is seen from where: cameras, pieces, their choice and geometry. Numbers only."""

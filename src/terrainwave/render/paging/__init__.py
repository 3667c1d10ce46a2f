"""What comes and goes as a camera moves: the scene, its workers, what servers send."""

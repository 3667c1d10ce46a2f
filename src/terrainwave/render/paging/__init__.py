"""Loading as a camera moves: the scene, its workers, data from servers."""

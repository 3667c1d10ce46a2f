"""Heights and meshes in the formats of others."""

"""How pictures look: colours, water, orthophotos, what is written over them."""

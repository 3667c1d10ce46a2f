"""Tasks on the workers of a cluster: what one takes, who does it, who does it again."""

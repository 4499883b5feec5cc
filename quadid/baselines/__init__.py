"""What the swarm is compared with: other optimisers, and black-box subspace models."""

"""What steps the physics of worlds."""

"""What fills an object: points with volumes, and samples of its surface."""

"""What is claimed about learning, recorded, trained and evaluated again: `make results`."""

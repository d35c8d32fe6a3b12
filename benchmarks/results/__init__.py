"""What is claimed about learning and speed: run by `make results`, written to `docs/reference/results.md`."""

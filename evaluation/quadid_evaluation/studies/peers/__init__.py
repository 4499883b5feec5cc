"""Other programs beside ours, on the same data: `make peers`."""

"""What the online service reaches: accuracy, changes, silence in hover, repeatability, load and memory."""

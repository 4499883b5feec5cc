"""What each rule and number of the diagnosis is good for: without it, or with half and twice it, what changes."""

"""Work of a command, without its files and its printing: checks, statuses, results.

The command line, the fleet, the studies and notebooks call the same functions; `import quadid` offers them.
"""

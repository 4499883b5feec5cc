"""Entry of the `quadid` command.

It stands outside the package, which refuses to be imported in a folder that would run foreign code.
"""

import sys


def main() -> int:
    """Runs the command; returns its exit code, 2 in such a folder."""
    try:
        from quadid.cli.main import app_main
    except ImportError as error:
        if error.name != "quadid":
            raise
        print(f"quadid: {error}", file=sys.stderr)  # noqa: T201 - a command's last word
        return 2
    return app_main()

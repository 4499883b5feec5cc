"""A process of its own: routes Zenoh with the given configuration until its input ends."""

import sys

import zenoh

session = zenoh.open(zenoh.Config.from_file(sys.argv[1]))
print("routing", flush=True)
sys.stdin.read()
session.close()  # type: ignore[no-untyped-call, unused-ignore]

"""quadid: identify the parameters of a multirotor simulation from flight data and name what it gets wrong.

Nothing heavy is imported here: import the rooms (`quadid.vehicle`, `quadid.identify`, …) where they are needed.
"""

__version__ = "0.1.0"

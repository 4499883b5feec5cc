"""`quadid vehicles`: the vehicles that ship."""

from __future__ import annotations

from quadid.cli.options import JsonTarget


def vehicles(json: JsonTarget = None) -> None:
    """List the vehicles that ship; each name may be given to --vehicle."""
    from quadid.app.init import shipped
    from quadid.cli import terminal
    from quadid.report.tables import Column, TextTable

    terminal.check_file(json, "--json")
    rows = shipped()
    terminal.write_json({"schema": "quadid.vehicles/1", "vehicles": rows}, json)
    columns = (
        Column("vehicle"), Column("rotors", right=True), Column("mass [kg]", right=True), Column("arm [m]", right=True),
        Column("command", rank=1), Column("description", rank=2),
    )  # fmt: skip
    cells = tuple(
        (r["name"], str(r["rotors"]), f"{r['mass']:.4g}", f"{r['arm']:.3g}", r["command"], r["description"])
        for r in rows
    )
    table = TextTable("Vehicles that ship (--vehicle NAME)", columns, cells)
    terminal.print_tables(terminal.console(quiet=json == "-"), [table])

"""The example notebooks run from top to bottom, and show what they promise."""

import os
import re
from pathlib import Path
from typing import Any

import pytest

import quadid


@pytest.fixture
def ran(repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs a notebook, with a cell of ours at its end, and returns it with its outputs."""
    nbformat = pytest.importorskip("nbformat", reason="pip install '.[notebook]'")
    nbclient = pytest.importorskip("nbclient", reason="pip install '.[notebook]'")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(repository), os.environ.get("PYTHONPATH", "")]))

    def run(name: str, last: str = "") -> Any:
        book = nbformat.read(repository / "examples" / f"{name}.ipynb", as_version=4)
        assert all(not cell.get("outputs") for cell in book.cells), "outputs are not kept in the repository"
        book.cells.append(nbformat.v4.new_code_cell(last))
        nbclient.NotebookClient(book, timeout=900, resources={"metadata": {"path": str(tmp_path)}}).execute()
        return book

    return run


def shown(book: Any) -> str:
    """Everything that the cells put out."""
    return "".join(str(output) for cell in book.cells for output in cell.get("outputs", []))


def test_the_notebook_runs(ran: Any, tmp_path: Path) -> None:
    out = shown(ran("identify"))
    assert "Thrust coefficient b" in out
    assert "motor_lag" in out
    assert "application/vnd.plotly" in out
    assert (tmp_path / "mine.yaml").is_file()


def test_from_a_log_to_a_controller_and_an_environment_in_sixty_lines(ran: Any) -> None:
    for needed in ("casadi", "gymnasium"):
        pytest.importorskip(needed)
    check = "from gymnasium.utils.env_checker import check_env\ncheck_env(Vehicles(), skip_render_check=True)"
    book = ran("log_to_controller", f"{check}\nprint('checked;', len(np.unique(drawn, axis=0)), 'vehicles')")
    *cells, _ = (cell["source"] for cell in book.cells if cell["cell_type"] == "code")
    code = "\n".join(cells)
    assert len([line for line in code.splitlines() if line.strip()]) < 60
    # Nothing but the documented functions, and one of the modules that want an extra package.
    assert not re.findall(r"from quadid|import quadid\.", code)
    assert set(re.findall(r"\bquadid\.(\w+)", code)) <= {*dir(quadid), "symbolic"}
    out = shown(book)
    assert "checked; 20 vehicles" in out
    left = re.search(r"metres from the goal after 3 s: \[([^]]*)\]", out)
    assert left is not None
    assert max(map(float, left[1].split())) < 0.1

"""tools/parts.py: what each row switches off, the comparison with the whole solver, and a run of all rows."""

import shutil

import pytest
from synthetic_views import CoordinateBackbone

from tools import parts
from tools.parts import WHOLE, differences, format_table, measure, read_errors, rows
from zsp_lite.data.samples import REPOSITORY
from zsp_lite.errors import InputError
from zsp_lite.verified.verification import ScoreWeights


def test_each_row_lacks_its_part_and_no_other():
    weights = ScoreWeights().without("orientation", "agreement")
    solvers = {name: row.settings["solver"] for name, row in rows().items()}
    assert solvers[WHOLE].weights == weights and solvers[WHOLE].icp and solvers[WHOLE].refinement
    assert rows(["view term"]).keys() == {WHOLE, "view term"}
    assert solvers["view term"].weights == weights.without("viewpoint")
    assert solvers["free space"].weights == weights.without("forward_free_space", "reverse_free_space")
    for name, solver in solvers.items():
        assert (not solver.icp) == ("soft ICP" in name) and (not solver.refinement) == ("refinement" in name)
        assert (solver.weights.viewpoint == 0) == ("view term" in name)
        assert (solver.weights.forward_silhouette == 0) == ("silhouettes" in name)
        assert (solver.weights.reverse_free_space == 0) == ("free space" in name)
        assert solver.weights.forward_similarity == weights.forward_similarity


def test_rows_are_compared_on_the_same_pairs():
    keys = [f"cup/s{i}:0/s{(i + 1) % 6}:1,2" for i in range(6)]
    whole = dict(zip(keys, [5.0, 5, 5, 5, 90, 90]))
    worse = dict(zip(reversed(keys), [5.0, 90, 90, 90, 5, 5]))  # another order
    table = differences({WHOLE: whole, "soft ICP": worse})
    assert table[WHOLE]["Acc30"] == pytest.approx(400 / 6) and table[WHOLE]["change"] == 0
    row = table["soft ICP"]
    assert (row["won"], row["lost"]) == (1, 2) and row["change"] == pytest.approx(-100 / 6) and row["p"] == 1
    assert row["low"] <= row["change"] <= row["high"]
    whole_line, line = format_table(table).splitlines()[2:]
    assert whole_line == "| whole | 66.7 | | | | |"
    assert line.startswith("| soft ICP | 50.0 | −16.7 [") and line.endswith("| 1 | 2 | 1.000 |")


def test_the_table_of_the_documentation_is_that_of_the_stored_runs():
    files = sorted((REPOSITORY / "notebooks" / "results" / "verified_parts").glob("*.json.gz"))
    assert format_table(differences(read_errors(files))) in (REPOSITORY / "docs" / "solvers.md").read_text()


@pytest.mark.slow
def test_a_run_of_all_rows_stores_the_error_of_every_pair(ellipsoids, tmp_path, monkeypatch):
    monkeypatch.setattr(parts, "check_sides", lambda folders, side: None)
    monkeypatch.setattr(parts, "load_backbone", lambda name: CoordinateBackbone())
    files = measure([(ellipsoids.root, 2)], tmp_path, "coordinates", rows())
    errors = read_errors(files)
    assert errors.keys() == rows().keys() and {len(found) for found in errors.values()} == {2}
    assert min(errors[WHOLE].values()) < 5
    with pytest.raises(InputError, match="expected different names"):
        measure([(ellipsoids.root, 2)] * 2, tmp_path, "coordinates", rows())


def test_categories_of_another_side_are_refused(tmp_path, capsys):
    (tmp_path / "data" / "drill").mkdir(parents=True)
    (tmp_path / "data" / "drill" / "frame_annotations.jgz").write_bytes(b"")
    assert parts.main([str(tmp_path / "out"), f"{tmp_path / 'data'}:2"]) == 2
    assert "category drill is for validation, expected training" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    shutil.rmtree(tmp_path / "data")
    assert parts.main([str(tmp_path / "out"), f"{tmp_path / 'data'}:2"]) == 2

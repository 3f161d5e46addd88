"""Comparisons of options files: what counts as fastest, ratios to a base file, and what is written."""

import csv
import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from petsc_fs.cli.main import main
from petsc_fs.errors import UsageError
from petsc_fs.tools import compare
from petsc_fs.tools.compare import Case, Comparison, Spread
from petsc_fs.tools.measure import EMPTY, Variant

FIELDS = {"momentum": 8, "mass": 4}


def record(file: str, rtol: float | None, seconds: float, error: float | None, **more: Any) -> dict[str, Any]:
    base = EMPTY | {
        "scene": "box.h5", "variant": file, "ranks": 1, "round": 0, "repetition": 0, "rtol": rtol, "phase": "solve",
        "kind": "converged", "message": "", "iterations": 2, "reason": "CONVERGED_RTOL", "true_residual": rtol or 1e-9,
        "seconds": {"read": 0.1, "setup": 1.0, "solve": seconds}, "peak_rss": [200 * 2**20], "base_rss": [100 * 2**20],
        "cpu_seconds": {"read": 0.05, "setup": 0.5, "solve": seconds / 2}, "forward_error": error,
    }  # fmt: skip
    return base | more


def comparison(records: list[dict[str, Any]], **more: Any) -> Comparison:
    reference = {"method": "LU", "corrections": [1.0, 1e-20], "backward_error": {"componentwise": 1e-16}}
    case = Case("box", "box.h5", 2, dict(FIELDS), "a box", reference=reference)
    files = tuple(dict.fromkeys(r["variant"] for r in records))
    variants = tuple(Variant(f, f, purpose=f"what {f} is", text="-ksp_type gmres <&>\n") for f in files)
    about = {"date": "2026-01-01 00:00", "complete": True}
    return replace(Comparison((case,), variants, (1,), (1e-2, 1e-6), 1, records, about), **more)


def three_files() -> list[dict[str, Any]]:
    """`slow` is the more accurate one, `lu` the most accurate one at any tolerance."""
    return [
        record("fast", 1e-2, 0.1, 1e-1),
        record("fast", 1e-6, 0.3, 1e-4),
        record("slow", 1e-2, 1.0, 1e-3),
        record("slow", 1e-6, 3.0, 1e-7),
        record("lu", 1e-2, 8.0, 1e-9),
        record("lu", 1e-6, 8.0, 1e-9),
    ]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1e-2..1e-5", (1e-2, 1e-3, 1e-4, 1e-5)),
        ("1e-5..1e-2", (1e-2, 1e-3, 1e-4, 1e-5)),
        ("1e-2..1e-6:2", (1e-2, 1e-4, 1e-6)),
        ("1e-3,0.5", (0.5, 1e-3)),
        ("1e-8", (1e-8,)),
    ],
)
def test_tolerances(text: str, expected: tuple[float, ...]) -> None:
    assert compare.rtols_of(text) == expected


@pytest.mark.parametrize("text", ["", "x", "1e-2..", "2", "0", "1e-2..0", "1e-2,nan"])
def test_tolerances_that_cannot_be(text: str) -> None:
    with pytest.raises(UsageError, match="--rtol"):
        compare.rtols_of(text)


def test_medians_and_quartiles_by_either_clock() -> None:
    records = [record("x", 1e-2, s, 0.1, round=k) for k, s in enumerate([5.0, 1.0, 2.0, 4.0, 3.0])]
    (point,) = compare.points(comparison(records))
    assert point.seconds["solve"] == Spread(3.0, 2.0, 4.0)
    assert point.seconds["total"] == Spread(4.0, 3.0, 5.0)
    assert point.ended and point.converged and point.memory == 100 * 2**20
    (point,) = compare.points(comparison(records, clock="cpu"))
    assert [point.seconds[what].median for what in ("setup", "solve", "total")] == [0.5, 1.5, 2.0]


def test_a_round_without_solution_disqualifies_and_a_missed_tolerance_does_not() -> None:
    missed = [record("x", 1e-2, 1.0, 0.1), record("x", 1e-2, 1.0, 0.1, kind="stagnated", round=1)]
    (point,) = compare.points(comparison(missed))
    assert point.ended and not point.converged
    assert compare.fastest([point], 0.1, "total") is not None
    crash = record("x", 1e-2, 0.0, None, round=2) | dict.fromkeys(EMPTY) | {"kind": "crash"}
    (point,) = compare.points(comparison([*missed, crash]))
    assert not point.ended
    assert compare.fastest([point], 0.1, "total") is None
    assert compare.points(comparison([crash])) == []


def test_fastest_for_each_accuracy() -> None:
    found = compare.points(comparison(three_files()))
    expected = {1e-1: ("fast", 0.1), 1e-2: ("fast", 0.3), 1e-5: ("slow", 3.0), 1e-9: ("lu", 8.0), 1e-10: None}
    winners = {a: compare.fastest(found, a, "solve") for a in expected}
    assert {a: w and (w.file, w.seconds) for a, w in winners.items()} == expected
    rows = compare.summary(comparison(three_files()), found)
    assert [row[2:] for row in rows] == [
        ["1e-01 … 1e-04", "fast 1.3 s", "fast 0.3 s"],
        ["1e-05 … 1e-07", "slow 4 s", "slow 3 s"],
        ["1e-08 … 1e-09", "lu 9 s", "lu 8 s"],
    ]


def test_overlapping_quartiles_are_a_tie() -> None:
    def rounds(file: str, seconds: list[float]) -> list[dict[str, Any]]:
        return [record(file, 1e-2, s, 0.1, round=k) for k, s in enumerate(seconds)]

    records = [*rounds("a", [1.0, 2.0, 3.0]), *rounds("b", [2.3, 2.6, 3.0]), *rounds("c", [2.6, 3.0, 3.4])]
    best = compare.fastest(compare.points(comparison(records)), 0.1, "solve")
    assert best is not None and (best.file, best.ties) == ("a", ("b",))  # quartiles 1.5..2.5, 2.45..2.8, 2.8..3.2


def test_ratios_are_medians_of_those_within_each_round() -> None:
    """The machine slows down by ten in the last round; the ratio does not see it."""
    records = [record("base", None, s, None, round=k) for k, s in enumerate([1.0, 2.0, 19.0])]
    records += [record("x", None, s, None, round=k) for k, s in enumerate([0.0, 0.5, 9.0])]
    found = comparison(records, base="base", rtols=())
    point = next(p for p in compare.points(found) if p.file == "x")
    assert point.ratios["total"].median == pytest.approx(0.5)  # 1/2, 1.5/3, 10/20
    assert point.ratios["setup"].median == 1.0
    rows = compare.ratio_rows(found, compare.points(found))
    assert rows[1][8] == "0.5 [0.5, 0.5]" and rows[-1][8] == "0.50, worst 0.50"
    assert rows[1][9] == "100"


# --- what is written


def assert_self_contained(text: str, pictures: int) -> None:
    """The page loads nothing but its pictures, and closes what it opens."""
    body = re.sub("<(style|script)>.*?</\\1>", "", text, flags=re.DOTALL)
    loaded = re.findall(r'<[^>]*(?:src|href|srcset|data|poster|action)="([^"]*)"', body)
    assert len(loaded) == pictures
    assert all(v.startswith("data:image/svg+xml;base64,") for v in loaded)
    tags = Counter(re.findall(r"<(/?\w+)", body))
    assert not set(tags) & {"script", "link", "iframe", "object", "embed"}
    assert all(tags[f"/{tag}"] == n for tag, n in tags.items() if tag[0] != "/" and tag not in ("meta", "img", "br"))
    style = text[text.index("<style>") : text.index("</style>")]
    assert "url(" not in style and "@import" not in style
    # What a screen reader asks for
    assert '<html lang="en">' in text and tags["main"] == tags["h1"] == 1
    assert tags["table"] == tags["caption"] == len(re.findall('tabindex="0" aria-label="[^"]+"><table>', text)) > 0
    assert len(re.findall('<th scope="(?:col|row)">', text)) == tags["th"] and '<th scope="col"></th>' not in text
    assert len(re.findall('<img alt="[^"]{20,}"', text)) == pictures


def test_page_is_whole_and_escapes_what_it_shows(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    records = [*three_files(), record("slow", 1e-2, 1.0, 1.0, kind="diverged", message="<b>boom</b>", round=1)]
    found = comparison(records)
    everything = compare.points(found)
    text = compare.page(found, everything, compare.draw(found, everything, tmp_path))
    assert_self_contained(text, 1)
    assert "<b>boom" not in text and "&lt;b&gt;boom" in text
    assert "-ksp_type gmres &lt;&amp;&gt;" in text
    assert "interrupted" not in text
    cut = replace(found, about=found.about | {"complete": False})
    assert "Measuring was interrupted" in compare.page(cut, everything, {})


def test_command_from_scene_to_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    misspelt = tmp_path / "misspelt.opts"
    pc = "-pc_type python\n-pc_python_type petsc_fs.pc.Assembled\n-assembled_pc_type ilu\n"
    misspelt.write_text(f"# wrong\n-ksp_type gmres\n{pc}-assembled_pc_factor_levles 1\n")
    out = tmp_path / "out"
    files = ["poromechanics.opts", "direct.opts", str(misspelt)]
    call = ["compare", "biot.h5", "--options", *files, "--rtol", "1e-4,1e-8", "--repeat", "1", "--out", str(out)]
    assert main([*call, "-n", "1"]) == 0
    said = capsys.readouterr()
    assert "misspelt" in said.err and "unused_option" in said.err
    assert re.search("^biot .* s", said.out, re.MULTILINE)  # whichever file is the fastest one today
    pictures = {f"work_precision_biot.{suffix}" for suffix in ("png", "svg")}
    written = {p.name for p in out.iterdir()}
    assert written == pictures | {"compare.html", "compare.csv", "compare.json", "reference_biot.npz"}
    assert_self_contained((out / "compare.html").read_text(encoding="utf-8"), 1)

    found = Comparison.from_json((out / "compare.json").read_text(encoding="utf-8"))
    assert json.loads(found.to_json()) == json.loads((out / "compare.json").read_text(encoding="utf-8"))
    kinds = {(r["variant"], r["rtol"]): r["kind"] for r in found.records}
    solved = {(file, rtol): "converged" for file in ("poromechanics", "direct") for rtol in (1e-4, 1e-8)}
    assert kinds == solved | {("misspelt", 1e-4): "unused_option"}
    errors = {(r["variant"], r["rtol"]): r["forward_error"] for r in found.records}
    assert errors["direct", 1e-4] < errors["poromechanics", 1e-8] < errors["poromechanics", 1e-4] < 1
    assert found.cases[0].reference["corrections"][-1] < 1e-20
    with (out / "compare.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(r["variant"], float(r["rtol"])) for r in rows] == list(kinds)
    assert float(rows[1]["forward_error"]) == found.records[1]["forward_error"]

    again = tmp_path / "again"
    assert main(["compare", "--again", str(out / "compare.json"), "--out", str(again)]) == 0
    assert (again / "compare.csv").read_text() == (out / "compare.csv").read_text()


def test_base_file_and_others_in_turns_without_a_folder(capsys: pytest.CaptureFixture[str]) -> None:
    call = ["compare", "flow.h5", "--base", "flow.opts", "--options", "flow.opts -ksp_rtol 1e-2", "--repeat", "1"]
    assert main(call) == 0
    said = capsys.readouterr()
    scenes = [line.split()[0] for line in said.out.splitlines() if not line.startswith(" ")]
    assert scenes == ["scene", "flow", "flow", "geometric", "mean"]  # broken for 80 columns
    assert "-ksp_rtol" in said.out and said.err == ""


@pytest.mark.parametrize(
    ("call", "code", "said"),
    [
        (["--out", "{tmp}/new"], 2, "at least one scene"),
        (["nothing.h5", "--out", "{tmp}/new"], 3, "no such file"),
        (["biot.h5"], 2, "--out"),
        (["biot.h5", "--rtol", "7", "--out", "{tmp}/new"], 2, "between 0 and 1"),
        (["biot.h5", "--ranks", "0", "--out", "{tmp}/new"], 2, "positive"),
        (["biot.h5", "--options", "flow.opts", "--out", "{tmp}/new"], 2, "for none of the scenes"),
        (["biot.h5", "--out", "{tmp}/file/x"], 2, "cannot be made"),
        (["--again", "{tmp}/file", "--out", "{tmp}/new"], 2, "not a comparison"),
    ],
)
def test_wrong_calls(call: list[str], code: int, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("{}")
    assert main(["compare", *(word.replace("{tmp}", str(tmp_path)) for word in call)]) == code
    error = capsys.readouterr().err.strip()
    assert said in error and len(error.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]

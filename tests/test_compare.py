"""Comparisons of options files: what is measured when, what counts as fastest, and what is written."""

import csv
import json
import re
import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pytest

from petsc_fs import choosing
from petsc_fs.cli.main import main
from petsc_fs.errors import UsageError
from petsc_fs.tools import compare, compare_page, compare_plots
from petsc_fs.tools.compare import Case, Comparison, Entry, Spread
from petsc_fs.tools.measure import EMPTY

FIELDS = {"momentum": 8, "mass": 4}


def entry(label: str, **more: Any) -> Entry:
    base: dict[str, Any] = {"fields": (), "not_for": (), "purpose": f"what {label} is", "text": "-ksp_type gmres <&>\n"}
    return Entry(label=label, path=f"{label}.opts", options={}, **(base | more))


def record(file: str, rtol: float, seconds: float, error: float, **more: Any) -> dict[str, Any]:
    history = {
        "seconds": [0.0, seconds / 2, seconds],
        "cpu_seconds": [0.0, seconds / 3, seconds],
        "residual": [1.0, 0.1, rtol],
        "forward_error": [1.0, 0.5, error],
        "residual_by_field": {f: [1.0, 0.1, 0.0] for f in FIELDS},
        "error_by_field": {f: [1.0, 0.5, error] for f in FIELDS},
    }
    base = EMPTY | {
        "scene": "box",
        "file": file,
        "ranks": 1,
        "round": 0,
        "repetition": 0,
        "rtol": rtol,
        "kind": "converged",
        "message": "",
        "phase": "solve",
        "iterations": 2,
        "reason": "CONVERGED_RTOL",
        "read_seconds": 0.1,
        "setup_seconds": 1.0,
        "solve_seconds": seconds,
        "cpu_by_phase": {"read": 0.05, "setup": 0.5, "solve": seconds / 2},
        "true_residual": rtol,
        "residual_by_field": dict.fromkeys(FIELDS, rtol),
        "forward_error": error,
        "error_by_field": dict.fromkeys(FIELDS, error),
        "backward_error": {"normwise": 1e-16, "componentwise": error},
        "peak_rss": [200e6],
        "base_rss": [100e6],
        "direct": file == "lu",
        "history": history,
    }
    return base | more


def comparison(records: list[dict[str, Any]], files: tuple[str, ...] = ("fast", "slow", "lu")) -> Comparison:
    reference = {
        "method": "LU",
        "refinements": 3,
        "corrections": [1.0, 1e-20],
        "backward_error": {"normwise": 1e-17, "componentwise": 1e-16},
        "residual_by_field": dict.fromkeys(FIELDS, 1e-16),
    }
    about = {
        "date": "2026-01-01 00:00",
        "seconds": 60.0,
        "load": 0.5,
        "time_limit": 300.0,
        "complete": True,
        "machine": {"processor": "abacus", "memory": "1 GiB", "system": "none", "threads per rank": "1"},
        "versions": {"petsc": "3.18.5"},
    }
    case = Case("box", "box.h5", 2, dict(FIELDS), "a box", reference)
    return Comparison((case,), tuple(map(entry, files)), (1,), (1e-2, 1e-6), 1, records, [], about)


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


# --- arguments


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


@pytest.mark.parametrize("text", ["1e-02..1e-12", "1e-02..1e-10:2", "0.01,0.003", "1e-08..1e-08"])
def test_tolerances_in_words(text: str) -> None:
    assert compare.rtol_words(compare.rtols_of(text)) == text


@pytest.mark.parametrize("text", ["", "x", "1e-2..", "2", "0", "1e-2..0", "1e-2,nan"])
def test_tolerances_that_cannot_be(text: str) -> None:
    with pytest.raises(UsageError, match="--rtol"):
        compare.rtols_of(text)


def test_petsc_options_go_to_every_run_and_n_does_not() -> None:
    ranks, options = compare.split_petsc(["-n", "1", "2", "-ksp_max_it", "7", "-ksp_monitor", "-scale", "-3"])
    assert ranks == [1, 2]
    assert options == {"ksp_max_it": "7", "ksp_monitor": None, "scale": "-3"}
    with pytest.raises(UsageError, match="-n"):
        compare.split_petsc(["-n", "many"])


def test_headers_say_which_files_apply() -> None:
    case = Case("box_fine", "box_fine.h5", 2, dict(FIELDS), "box (refinement=2)")
    assert entry("a").applies(case)
    assert entry("a", fields=("momentum", "mass")).applies(case)
    assert not entry("a", fields=("mass",)).applies(case)
    assert not entry("a", not_for=("box",)).applies(case)
    assert not entry("a", not_for=("box_fine",)).applies(case)


# --- what is measured when


def test_each_round_has_each_combination_once_and_starts_with_another_file() -> None:
    cases = [Case(name, name, 2, dict(FIELDS), "") for name in ("a", "b")]
    entries = [entry("x"), entry("y"), entry("z", not_for=("b",))]
    rounds: list[list[tuple[str, int, str]]] = [[], [], []]
    for number, case, ranks, file in compare.schedule(cases, entries, (1, 2), 3):
        rounds[number].append((case.label, ranks, file.label))
    assert all(Counter(r) == Counter(rounds[0]) and len(set(r)) == len(r) == 10 for r in rounds)
    assert [r[0] for r in rounds] == [("a", 1, "x"), ("a", 1, "y"), ("a", 1, "z")]


def run_with(monkeypatch: pytest.MonkeyPatch, results: list[Any]) -> tuple[Any, list[str]]:
    """Two files, three rounds; each process gives the next of the results, or raises it."""
    measured = []

    def measure(job: Any, mpiexec: Any) -> list[dict[str, Any]]:
        measured.append(str(job.options_file))
        result = results.pop(0)
        if isinstance(result, BaseException):
            raise result
        return [result]

    monkeypatch.setattr(compare, "measure", measure)
    case = Case("box", "box.h5", 2, dict(FIELDS), "")
    found = compare.run(
        [case], [entry("x"), entry("y")], ranks=(1,), rtols=(1e-2,), repeat=3, references={"box": Path("box.npz")}
    )
    return found, measured


def test_a_file_that_hangs_is_not_measured_again(monkeypatch: pytest.MonkeyPatch) -> None:
    good, hang = record("", 1e-2, 1.0, 0.1), record("", 1e-2, 0.0, 0.0, kind="hang", forward_error=None)
    (records, given_up, complete), measured = run_with(monkeypatch, [good, hang, good, good])
    assert measured == ["x.opts", "y.opts", "x.opts", "x.opts"]
    assert [(r["file"], r["round"], r["kind"]) for r in records] == [
        ("x", 0, "converged"),
        ("y", 0, "hang"),
        ("x", 1, "converged"),
        ("x", 2, "converged"),
    ]
    assert given_up == [{"scene": "box", "file": "y", "ranks": 1}]
    assert complete


def test_interrupt_keeps_what_was_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    good = record("", 1e-2, 1.0, 0.1)
    (records, _, complete), _ = run_with(monkeypatch, [good, good, good, KeyboardInterrupt()])
    assert (len(records), complete) == (3, False)
    with pytest.raises(KeyboardInterrupt):
        run_with(monkeypatch, [KeyboardInterrupt()])


# --- what counts


def test_medians_and_quartiles() -> None:
    records = [record("x", 1e-2, s, 0.1, round=k) for k, s in enumerate([5.0, 1.0, 2.0, 4.0, 3.0])]
    (point,) = compare.points(records)
    assert point.solve == Spread(3.0, 2.0, 4.0)
    assert point.total == Spread(4.0, 3.0, 5.0)
    assert point.ended and point.converged
    (point,) = compare.points(records, "cpu")
    assert (point.setup.median, point.solve.median, point.total.median) == (0.5, 1.5, 2.0)


def test_a_round_without_solution_disqualifies_and_a_missed_tolerance_does_not() -> None:
    missed = [record("x", 1e-2, 1.0, 0.1), record("x", 1e-2, 1.0, 0.1, kind="stagnated")]
    (point,) = compare.points(missed)
    assert point.ended and not point.converged
    assert compare.fastest([point], 0.1, lambda p: p.total) is not None
    crash = EMPTY | {"scene": "box", "file": "x", "ranks": 1, "rtol": 1e-2, "kind": "crash"}
    (point,) = compare.points([*missed, crash])
    assert not point.ended
    assert compare.fastest([point], 0.1, lambda p: p.total) is None
    assert compare.points([crash]) == []


def test_fastest_for_each_accuracy() -> None:
    found = compare.points(three_files())
    winners = {a: compare.fastest(found, a, lambda p: p.solve) for a in (1e-1, 1e-2, 1e-5, 1e-9, 1e-10)}
    assert {a: w and (w.file, w.seconds) for a, w in winners.items()} == {
        1e-1: ("fast", 0.1),
        1e-2: ("fast", 0.3),
        1e-5: ("slow", 3.0),
        1e-9: ("lu", 8.0),
        1e-10: None,
    }


def test_overlapping_quartiles_are_a_tie() -> None:
    def rounds(file: str, seconds: list[float]) -> list[dict[str, Any]]:
        return [record(file, 1e-2, s, 0.1) for s in seconds]

    records = [*rounds("a", [1.0, 2.0, 3.0]), *rounds("b", [2.3, 2.6, 3.0]), *rounds("c", [2.6, 3.0, 3.4])]
    best = compare.fastest(compare.points(records), 0.1, lambda p: p.solve)
    assert best is not None and (best.file, best.ties) == ("a", ("b",))  # quartiles 1.5..2.5, 2.45..2.8, 2.8..3.2


def test_accuracies_with_the_same_winners_are_one_verdict() -> None:
    found = compare.verdicts(comparison(three_files()))
    assert [(v.label, v.winners["solve alone"][0].file) for v in found if v.winners["solve alone"]] == [
        ("1e-01 … 1e-04", "fast"),
        ("1e-05 … 1e-07", "slow"),
        ("1e-08 … 1e-09", "lu"),
    ]
    assert compare.seconds_words(found[0].winners["solve alone"] or []) == "0.1–0.3 s"


# --- what is written


class References(HTMLParser):
    """What a page would load, and its tags."""

    def __init__(self) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loaded += [v or "" for k, v in attrs if k in ("src", "href", "srcset", "data", "poster", "action")]
        assert tag not in ("script", "link", "iframe", "object", "embed")
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def assert_self_contained(text: str, pictures: int) -> None:
    parser = References()
    parser.feed(text)
    parser.close()
    assert parser.open == []
    assert len(parser.loaded) == pictures
    assert all(v.startswith("data:image/svg+xml;base64,") for v in parser.loaded)
    style = "".join(re.findall("<style>(.*?)</style>", text, flags=re.DOTALL))
    assert style and "url(" not in style and "@import" not in style


def test_page_is_whole_and_escapes_what_it_shows(tmp_path: Path) -> None:
    records = [*three_files(), record("slow", 1e-2, 1.0, 1.0, kind="diverged", message="<b>boom</b>", round=1)]
    found = comparison(records)
    pictures = compare_plots.draw(found, tmp_path)
    assert [p.kind for p in pictures] == list(compare_plots.KINDS)
    text = compare_page.page(found, pictures)
    assert_self_contained(text, 3)
    assert "<b>boom" not in text and "&lt;b&gt;boom" in text
    assert "-ksp_type gmres &lt;&amp;&gt;" in text
    assert "interrupted" not in text
    cut = replace(found, about=found.about | {"complete": False})
    assert "Measuring was interrupted" in compare_page.page(cut, pictures)


@pytest.mark.parametrize("clock", list(compare.CLOCKS))
def test_axes_have_labels_with_units(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, clock: str) -> None:
    figures = []
    monkeypatch.setattr(compare_plots, "_save", lambda figure, path: (figures.append(figure), (path, path))[1])
    compare_plots.draw(replace(comparison(three_files()), clock=clock), tmp_path)
    for figure in figures:
        axes = figure.axes
        assert all(re.search(r"seconds|\(MB\)", a.get_xlabel()) for a in axes if a.get_subplotspec().is_last_row())
        first = [a for a in axes if a.get_subplotspec().is_first_col()]
        assert all("(1)" in a.get_ylabel() or a.get_yticklabels() for a in first)
        assert figure.legends or any(a.get_legend() for a in axes)
    plt.close("all")
    assert len(figures) == 3


def test_a_dot_in_the_name_of_a_scene_is_kept(tmp_path: Path) -> None:
    found = comparison(
        [record("fast", 1e-2, 0.1, 0.1, scene="box_0.5"), record("fast", 1e-2, 0.1, 0.1, scene="box_0.7")]
    )
    cases = tuple(replace(found.cases[0], label=f"box_{size}") for size in (0.5, 0.7))
    compare_plots.draw(replace(found, cases=cases), tmp_path, ("cost",))
    names = {p.name for p in tmp_path.iterdir()}
    assert names == {f"cost_box_{size}.{suffix}" for size in (0.5, 0.7) for suffix in ("png", "svg")}


def test_files_differ_by_more_than_colour() -> None:
    looks = list(compare_plots.looks([entry(f"f{k}") for k in range(35)]).values())
    assert len({(look.colour, look.marker) for look in looks}) == 35
    assert len({(look.marker, str(look.dashes)) for look in looks[:5]}) == 5
    assert len({look.marker for look in looks[:8]}) == 8


def test_choosing_page(tmp_path: Path) -> None:
    written = choosing.write_page([comparison(three_files())], tmp_path / "choosing.md")
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(p.name for p in written)
    text = written[0].read_text(encoding="utf-8")
    call = "petsc-fs compare box.h5 --options fast.opts slow.opts lu.opts --rtol 0.01,1e-06 --ranks 1 --repeat 1"
    assert call in text
    assert "| box (2D, 12) | 1 | 1e-05 … 1e-07 | `slow` 4 s | `slow` 3 s |" in text
    assert "| box (2D, 12) | `lu` 9 s, 200 MB | `slow` 4 s, 200 MB | 2.2 |" in text
    assert "| box (2D, 12) | `slow` | 1e-02 | 1e-06 | – |" in text
    assert "takes longer on box (2D, 12) (2.2 times as long)" in text
    assert "the worst (`fast` on box, 1e-06) has an error of 1.0e-04" in text
    for picture in re.findall(r"!\[.*\]\((.*)\)", text):
        assert (tmp_path / picture).is_file()


def test_command_from_scene_to_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    misspelt = tmp_path / "misspelt.opts"
    misspelt.write_text("# wrong\n-ksp_type gmres\n-pc_type ilu\n-petsc_fs_mat_type aij\n-pc_factor_levles 1\n")
    out = tmp_path / "out"
    files = ["poromechanics.opts", "direct.opts", str(misspelt)]
    call = ["compare", "biot.h5", "--options", *files, "--rtol", "1e-2,1e-8", "--repeat", "1", "--out", str(out)]
    assert main([*call, "-n", "1"]) == 0
    said = capsys.readouterr()
    assert "misspelt" in said.err and "unused_option" in said.err and "fastest" in said.out
    names = {p.name for p in out.iterdir()}
    drawn = {f"{kind}_biot.{suffix}" for kind in compare_plots.KINDS for suffix in ("png", "svg")}
    assert names == drawn | {"compare.html", "compare.csv", "compare.json", "reference_biot.npz"}
    for name in drawn:
        data = (out / name).read_bytes()
        assert data.startswith(b"\x89PNG") if name.endswith("png") else ET.fromstring(data).tag.endswith("svg")
    assert_self_contained((out / "compare.html").read_text(encoding="utf-8"), 3)

    found = Comparison.from_json((out / "compare.json").read_text(encoding="utf-8"))
    assert json.loads(found.to_json()) == json.loads((out / "compare.json").read_text(encoding="utf-8"))
    kinds = {(r["file"], r["rtol"]): r["kind"] for r in found.records}
    assert kinds == {
        ("poromechanics", 1e-2): "converged",
        ("poromechanics", 1e-8): "converged",
        ("direct", 1e-2): "converged",
        ("direct", 1e-8): "converged",
        ("misspelt", 1e-2): "unused_option",
    }
    errors = {(r["file"], r["rtol"]): r["forward_error"] for r in found.records}
    assert errors["direct", 1e-2] < errors["poromechanics", 1e-8] < errors["poromechanics", 1e-2] < 1
    assert found.cases[0].reference["corrections"][-1] < 1e-20
    with (out / "compare.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(r["file"], float(r["rtol"])) for r in rows] == list(kinds)
    assert float(rows[1]["forward_error"]) == found.records[1]["forward_error"]

    again = tmp_path / "again"
    assert main(["compare", "--again", str(out / "compare.json"), "--out", str(again)]) == 0
    assert (again / "compare.csv").read_text() == (out / "compare.csv").read_text()
    assert (again / "work_precision_biot.svg").read_bytes() == (out / "work_precision_biot.svg").read_bytes()


@pytest.mark.parametrize(
    ("call", "code", "said"),
    [
        (["--out", "{tmp}/new"], 2, "at least one scene"),
        (["nothing.h5", "--out", "{tmp}/new"], 3, "no such file"),
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

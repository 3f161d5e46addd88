"""Options files found, read and checked; options that nothing used, and what was probably meant."""

import ctypes
from pathlib import Path

import pytest
from mpi4py import MPI
from petsc4py import PETSc

from petsc_fs import options
from petsc_fs.errors import UsageError
from petsc_fs.options import Given

SHIPPED = sorted(p.name for p in options.shipped_folder().glob("*.opts"))


@pytest.fixture
def opts(tmp_path):
    """Write an options file."""

    def write(text: str) -> Path:
        path = tmp_path / "mine.opts"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_prefixes_nest_and_comments_vanish(opts):
    text = """\
# -not_an_option 1
-ksp_type gmres   # the outer one
-ksp_monitor
-prefix_push a_
  -pc_type hypre
  -prefix_push b_
    -eigenvalue_range 0.1,-2  -flag -monitor "ascii:a file.txt"
  -prefix_pop

\t-tol -1e-3
-prefix_pop
-last 1,2
"""
    assert options.parse(opts(text)) == {
        "ksp_type": "gmres",
        "ksp_monitor": None,
        "a_pc_type": "hypre",
        "a_b_eigenvalue_range": "0.1,-2",
        "a_b_flag": None,
        "a_b_monitor": "ascii:a file.txt",
        "a_tol": "-1e-3",
        "last": "1,2",
    }


@pytest.mark.parametrize("name", SHIPPED)
def test_petsc_reads_the_same_from_a_file(clean, name):
    path = options.shipped_folder() / name
    before = clean.getAll()
    library = ctypes.CDLL(PETSc.__file__)
    clean.prefixPush("same_")
    failed = library.PetscOptionsInsertFile(ctypes.c_void_p(comm_handle()), None, str(path).encode(), 1)
    clean.prefixPop()
    assert not failed
    found = {n.removeprefix("same_"): v or None for n, v in clean.getAll().items() if n not in before}
    assert found == options.parse(path)


def comm_handle() -> int:
    """PETSC_COMM_SELF as C has it."""
    address = MPI._addressof(MPI.COMM_SELF)
    kind = ctypes.c_void_p if MPI._sizeof(MPI.Comm) == ctypes.sizeof(ctypes.c_void_p) else ctypes.c_int
    return kind.from_address(address).value


FORMS = {
    "unix": lambda text: text.encode(),
    "windows": lambda text: text.replace("\n", "\r\n").encode(),
    "old_mac": lambda text: text.replace("\n", "\r").encode(),
    "byte_order_mark": lambda text: b"\xef\xbb\xbf" + text.encode(),
    "tabs": lambda text: text.replace(" ", "\t").encode(),
    "no_last_line_end": lambda text: text.rstrip().encode(),
    "line_separator_in_a_comment": lambda text: text.replace("outer", "\u2028-x 1").encode(),
}


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_any_editor_will_do(tmp_path, form):
    (tmp_path / "mine.opts").write_bytes(form("-ksp_type gmres # outer\n-prefix_push a_\n-pc_type lu\n-prefix_pop\n"))
    assert options.parse(tmp_path / "mine.opts") == {"ksp_type": "gmres", "a_pc_type": "lu"}


def test_a_file_may_name_others_in_their_place(tmp_path, opts, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "inner.opts").write_text("-a 1\n-b 1\n")
    path = opts("-a 0\n-options_file inner.opts\n-b 2\n-prefix_push p_\n-options_file inner.opts\n-prefix_pop\n")
    assert options.parse(path) == {"a": "1", "b": "2", "p_a": "1", "p_b": "1"}
    (tmp_path / "inner.opts").write_text("-a\n-options_file mine.opts\n")
    with pytest.raises(UsageError, match=r"mine.opts:2: .*inner.opts:2: options file .*mine.opts includes itself"):
        options.parse(path)
    (tmp_path / "inner.opts").unlink()
    with pytest.raises(UsageError, match=r"mine.opts:2: options file inner.opts: no such file; shipped are "):
        options.parse(path)


BAD_LINES = {
    "no_dash": ("-a 1\nksp_type gmres\n", ":2: 'ksp_type' is not an option; options start with '-'"),
    "number": ("\n\n-5 x\n", ":3: '-5' is not an option"),
    "lone_dash": ("# c\n- ksp_type gmres\n", ":2: '-' is not an option"),
    "two_dashes": ("--ksp_type gmres\n", ":1: '--ksp_type' is not an option"),
    "stray": ("\n-ksp_rtol 1e-10 5\n", ":2: '5' belongs to no option: -ksp_rtol has its value already"),
    "equals": ("-ksp_rtol=1e-3\n", ":1: -ksp_rtol=1e-3: a space, no '=', goes between an option and its value"),
    "no_break_space": ("-ksp_type\u00a0cg\n", ":1: -ksp_type\u00a0cg: PETSc cannot take the character U+00A0"),
    "line_separator": ("-a 1\u2028-b 2\n", ":1: -a: PETSc cannot take the character U+2028"),
    "no_file": ("-options_file\n", ":1: -options_file without the name of the file"),
    "push_nothing": ("-a\n-prefix_push # qr_\n", ":2: -prefix_push without a prefix"),
    "pop_too_often": (
        "-prefix_push a_\n-prefix_pop\n-prefix_pop\n",
        ":3: -prefix_pop without a -prefix_push before it",
    ),
    "pop_too_seldom": ("-prefix_push a_\n-prefix_push b_\n-c\n", ": 2 -prefix_push without a -prefix_pop"),
}


@pytest.mark.parametrize(("text", "message"), BAD_LINES.values(), ids=BAD_LINES)
def test_a_bad_line_is_named_by_its_number(opts, text, message):
    path = opts(text)
    with pytest.raises(UsageError) as error:
        options.parse(path)
    assert str(error.value).startswith(f"{path}{message}")


def test_a_file_that_is_no_text_is_refused(opts):
    path = opts("")
    for content in (b"\x89HDF\r\n\x1a\n\xff\xff", "-a\n".encode("utf-16"), b"-ksp_type cg\x00\n"):
        path.write_bytes(content)
        for read in (options.parse, options.read_header):
            with pytest.raises(UsageError, match="not readable as text"):
                read(path)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("ksp_rtol", "nan", "-ksp_rtol nan: expected a number from 0 to below 1"),
        ("ksp_rtol", "1", "-ksp_rtol 1: expected a number from 0 to below 1"),
        ("a_ksp_rtol", "inf", "-a_ksp_rtol inf: expected a number from 0 to below 1"),
        ("ksp_rtol", None, "-ksp_rtol without a value: expected a number from 0 to below 1"),
        ("ksp_rtol", "", "-ksp_rtol without a value: expected a number from 0 to below 1"),
        ("ksp_rtol", "-1e-3", "-ksp_rtol -1e-3: expected a number from 0 to below 1"),
        ("ksp_rtol", "1e-3x", "-ksp_rtol 1e-3x: expected a number from 0 to below 1"),
        ("ksp_atol", "nan", "-ksp_atol nan: expected a number from 0 on"),
        ("ksp_max_it", "1.5", "-ksp_max_it 1.5: expected a whole number from 0 on"),
        ("ksp_gmres_restart", "0", "-ksp_gmres_restart 0: expected a whole number from 1 on"),
    ],
)
def test_numbers_that_decide_when_to_stop_are_looked_at(name, value, expected):
    with pytest.raises(UsageError) as error:
        options.check({"ksp_type": "gmres", name: value})
    assert str(error.value) == expected


def test_other_numbers_pass():
    options.check({"ksp_rtol": "0", "ksp_atol": "1e-50", "ksp_max_it": "DEFAULT", "my_ksp_rtol_x": "nan", "a": None})
    for file in options.shipped():
        options.check(options.parse(file.path))


def test_insert_leaves_what_is_set_already(opts, clean):
    path = opts("-level_tol 1\n-prefix_push level_\n-flag\n-steps 3\n-prefix_pop\n")
    clean["mine_level_tol"] = "7"
    options.insert(path, "mine_")
    found = {n: v or None for n, v in clean.getAll().items() if n.startswith("mine_")}
    assert found == {"mine_level_tol": "7", "mine_level_flag": None, "mine_level_steps": "3"}


def test_header_says_what_a_file_is_for(opts):
    path = opts("# Fast one\n#\n# fields: mass, momentum\n# default: yes\n# not_for: model1 model3\n-a # fields: x\n")
    header = options.read_header(path)
    assert header == options.OptionsFile(path, "Fast one", ("momentum", "mass"), True, ("model1", "model3"))
    assert header.fits(["mass", "momentum"]) and header.fits(["momentum", "mass"])
    assert not header.fits(["mass"]) and not header.fits(["mass", "momentum", "intf_flow"])


def test_a_file_without_header_is_for_any_fields_but_no_default(opts):
    header = options.read_header(opts("-ksp_type gmres\n"))
    assert header == options.OptionsFile(header.path, "", (), False, ())
    assert header.fits(["mass"]) and header.fits([])


def test_a_path_is_taken_before_a_shipped_name(tmp_path, monkeypatch, opts):
    monkeypatch.chdir(tmp_path)
    shipped = options.shipped_folder() / "flow.opts"
    assert options.find_options_file("flow.opts") == shipped
    assert options.find_options_file("options/flow.opts") == shipped
    assert options.find_options_file(str(opts(""))) == tmp_path / "mine.opts"
    Path("flow.opts").write_text("-a\n")
    assert options.find_options_file("flow.opts").resolve() == tmp_path / "flow.opts"


@pytest.mark.parametrize("name", ["folw.opts", "elsewhere/flow.opts", "."])
def test_a_missing_file_is_answered_by_what_is_shipped(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError) as error:
        options.find_options_file(name)
    assert str(error.value) == f"options file {name}: no such file; shipped are {', '.join(SHIPPED)}"


@pytest.mark.mpi
def test_options_are_unused_until_somebody_asks(clean):
    values = {"one": "1", "two": "2", "ksp_type": "cg", "pc_type": "jacobi", "pc_tpye": "ilu"}
    options.insert_all(values, "tst_")
    assert {f"tst_{name}" for name in values} <= set(options.unused())
    assert clean.getInt("tst_one") == 1
    ksp = PETSc.KSP().create(PETSc.COMM_SELF)
    ksp.setOptionsPrefix("tst_")
    ksp.setFromOptions()
    ksp.destroy()
    assert [name for name in options.unused() if name.startswith("tst_")] == ["tst_pc_tpye", "tst_two"]


MECHANICS = "qr_fieldsplit_1_fieldsplit_mechanics_component_"


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        (f"{MECHANICS}pc_hypre_boomeramg_stong_threshold", f"{MECHANICS}pc_hypre_boomeramg_strong_threshold"),
        ("qr_fieldsplit_1_feildsplit_mechanics_pc_type", "qr_fieldsplit_1_fieldsplit_mechanics_pc_type"),
        ("ksp_rtoll", "ksp_rtol"),
        ("qr_sidee", "qr_side"),
        ("petsc_fs_partitoin", "petsc_fs_partition"),
        ("ksp_montior", "ksp_monitor"),
        ("zzzzzzzz", None),
    ],
)
def test_what_a_misspelt_option_may_have_meant(clean, name, expected):
    clean[name] = "1"
    text = options.explain([name], {name})
    hint = f"; did you mean -{expected}" if expected else ""
    assert text.startswith(f"option -{name} from the command line was not used{hint}")
    assert text.endswith("?" if expected else "not used")


def test_given_options_count_in_their_order(opts):
    path = opts("-ksp_rtol 1e-3\n-ksp_max_it 7\n")
    given = Given.of(["-ksp_max_it", "5", "-options_file", str(path), "--ksp_rtol", "1e-4", "-flag", "-shift", "-1"])
    assert given.values == {"ksp_max_it": "7", "ksp_rtol": "1e-4", "flag": None, "shift": "-1"}
    assert given.files == (path,)
    for words, message in (
        (["-ksp_rtol", "nan"], "-ksp_rtol nan: expected a number"),
        (["-a", "1", "2"], "'2' belongs to no option: -a has its value already"),
        (["-options_file"], "-options_file without the name of the file"),
        (["-prefix_push", "x_", "-a"], "the command line: 1 -prefix_push without a -prefix_pop"),
        (["-a", "caf\udce9"], r"-a: PETSc cannot take the character U\+DCE9"),
    ):
        with pytest.raises(UsageError, match=message):
            Given.of(words)


@pytest.mark.mpi
def test_an_option_that_one_rank_used_is_used_and_the_others_are_told_alike_on_all(clean, monkeypatch):
    comm = MPI.COMM_WORLD
    monkeypatch.setenv("PETSC_OPTIONS", "-tst_foreign -tst_snes 3")
    given = Given.of(["-tst_some", "1", "-tst_none", "2", "-ksp_rtoll", "1"])
    options.insert_all(given.values | {"tst_foreign": None, "tst_snes": "3"})
    if comm.rank == comm.size - 1:
        assert clean.getInt("tst_some") == 1
    with pytest.raises(UsageError) as error:
        given.judge(comm)
    assert str(error.value).splitlines() == [
        "2 options were not used:",
        "  option -ksp_rtoll from the command line was not used; did you mean -ksp_rtol or -ksp_atol?",
        "  option -tst_none from the command line was not used",
    ]
    for name in ("tst_none", "ksp_rtoll"):
        clean.getInt(name)
    foreign = [f"  option -{name} from PETSC_OPTIONS was not used" for name in ("tst_foreign", "tst_snes")]
    expected = ["2 options were not used:", *foreign] if comm.rank == 0 else []
    assert given.judge(comm).splitlines() == expected
    clean["petsc_fs_allow_unused"] = "tst_*"
    assert given.judge(comm) == ""

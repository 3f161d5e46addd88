"""Options files found, read and checked; options that nothing used, and what was probably meant."""

import ctypes
from pathlib import Path

import pytest
from petsc4py import PETSc
from sample import SCENES

from petsc_fs import options
from petsc_fs.errors import UsageError
from petsc_fs.io import hdf5

SHIPPED = sorted(p.name for p in options.shipped_folder().glob("*.opts"))


@pytest.fixture
def database():
    """PETSc's options; what a test adds is gone after it."""
    mine = PETSc.Options()
    before = mine.getAll()
    yield mine
    for name in set(mine.getAll()) - set(before):
        mine.delValue(name)


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
    -eigenvalue_range 0.1 -2
  -prefix_pop

\t-tol -1e-3
-prefix_pop
-last 1,2
"""
    assert options.parse(opts(text)) == {
        "ksp_type": "gmres",
        "ksp_monitor": None,
        "a_pc_type": "hypre",
        "a_b_eigenvalue_range": "0.1 -2",
        "a_tol": "-1e-3",
        "last": "1,2",
    }


@pytest.mark.parametrize("name", SHIPPED)
def test_petsc_reads_the_same_from_a_file(database, name):
    path = options.shipped_folder() / name
    before = database.getAll()
    library = ctypes.CDLL(PETSc.__file__)
    database.prefixPush("same_")
    failed = library.PetscOptionsInsertFile(ctypes.c_void_p(comm_handle()), None, str(path).encode(), 1)
    database.prefixPop()
    assert not failed
    found = {n.removeprefix("same_"): v or None for n, v in database.getAll().items() if n not in before}
    assert found == options.parse(path)


def comm_handle() -> int:
    """PETSC_COMM_SELF as C has it."""
    from mpi4py import MPI

    address = MPI._addressof(MPI.COMM_SELF)
    kind = ctypes.c_void_p if MPI._sizeof(MPI.Comm) == ctypes.sizeof(ctypes.c_void_p) else ctypes.c_int
    return kind.from_address(address).value


BAD_LINES = {
    "no_dash": ("-a 1\nksp_type gmres\n", ":2: 'ksp_type' is not an option; options start with '-'"),
    "number": ("\n\n-5 x\n", ":3: '-5' is not an option"),
    "lone_dash": ("# c\n- ksp_type gmres\n", ":2: '-' is not an option"),
    "two_dashes": ("--ksp_type gmres\n", ":1: '--ksp_type' is not an option"),
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
    path.write_bytes(b"\x89HDF\r\n\x1a\n\xff\xff")
    for read in (options.parse, options.read_header):
        with pytest.raises(UsageError, match="not readable as text"):
            read(path)


def test_insert_leaves_what_is_set_already(opts, database):
    path = opts("-level_tol 1\n-prefix_push level_\n-flag\n-steps 3\n-prefix_pop\n")
    database["mine_level_tol"] = "7"
    options.insert(path, "mine_")
    found = {n: v or None for n, v in database.getAll().items() if n.startswith("mine_")}
    assert found == {"mine_level_tol": "7", "mine_level_flag": None, "mine_level_steps": "3"}


def test_header_says_what_a_file_is_for(opts):
    path = opts("# Fast one\n#\n# fields: mass, momentum\n# default: yes\n# not_for: model1 model3\n-a # fields: x\n")
    assert options.read_header(path) == options.OptionsFile(
        path, "Fast one", ("momentum", "mass"), default=True, not_for=("model1", "model3")
    )


def test_a_file_without_header_is_for_any_fields_but_no_default(opts):
    header = options.read_header(opts("-ksp_type gmres\n"))
    assert (header.purpose, header.fields, header.default, header.not_for) == ("", (), False, ())
    assert header.fits(["mass"])
    assert header.fits([])


def test_a_file_fits_its_fields_in_any_order_no_more_and_no_fewer(opts):
    header = options.read_header(opts("# x\n# fields: mass momentum\n"))
    assert header.fits(["mass", "momentum"])
    assert header.fits(["momentum", "mass"])
    assert not header.fits(["mass"])
    assert not header.fits(["mass", "momentum", "intf_flow"])


DEFAULTS = {
    "model1": "contact_poromechanics_fast.opts",
    "model2": "contact_poromechanics_fast.opts",
    "model3": "contact_poromechanics_fast.opts",
    "contact": "contact_mechanics_fast.opts",
    "biot": "poromechanics_fast.opts",
    "flow": "flow_fast.opts",
}


@pytest.mark.parametrize(("scene", "file"), DEFAULTS.items(), ids=DEFAULTS)
def test_every_bundled_scene_has_its_default(scene, file):
    _, sizes = hdf5.read_sizes(SCENES / f"{scene}.h5")
    assert options.default_for(reversed(list(sizes))) == options.shipped_folder() / file


def test_the_table_of_defaults_is_complete():
    assert set(DEFAULTS) == {p.stem for p in SCENES.glob("*.h5")}
    fields = [file.fields for file in options.shipped() if file.default]
    assert len(fields) == len(set(fields))


@pytest.mark.parametrize("fields", [["contact"], ["mass", "contact"], []], ids=lambda f: "+".join(f) or "none")
def test_other_fields_have_no_default(fields):
    with pytest.raises(UsageError, match=r"no default solver for the fields .*: name one with -options_file"):
        options.default_for(fields)


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
def test_options_are_unused_until_somebody_asks(database):
    database["tst_one"], database["tst_two"] = "1", "2"
    assert {"tst_one", "tst_two"} <= set(options.unused())
    assert database.getInt("tst_one") == 1
    assert "tst_one" not in options.unused()
    assert "tst_two" in options.unused()


def use(prefix: str) -> None:
    """Let a KSP take its options."""
    ksp = PETSc.KSP().create(PETSc.COMM_SELF)
    ksp.setOptionsPrefix(prefix)
    ksp.setFromOptions()
    ksp.destroy()


@pytest.mark.mpi
def test_a_solver_uses_its_options_and_no_others(database):
    database["tst_ksp_type"], database["tst_pc_type"], database["tst_pc_tpye"] = "cg", "jacobi", "ilu"
    use("tst_")
    assert [name for name in options.unused() if name.startswith("tst_")] == ["tst_pc_tpye"]


LONG = "fieldsplit_1_fieldsplit_mechanics_" * 3
"""More than 64 characters, where PETSc 3.18 overruns a buffer if it prints the help."""


@pytest.mark.mpi
@pytest.mark.parametrize("prefix", ["", "tst_", LONG], ids=["none", "short", "long"])
def test_known_names_are_those_that_petsc_explains(database, capfd, prefix):
    chosen = {"ksp_type": "gmres", "pc_type": "hypre", "pc_hypre_type": "boomeramg"}
    for name, value in chosen.items():
        database[prefix + name] = value
    database[prefix + "ksp_rotl"] = "1"
    use(prefix)
    before = database.getAll()
    names = options.known_names()
    expected = {*chosen, "ksp_rtol", "ksp_gmres_restart", "pc_hypre_boomeramg_strong_threshold"}
    assert {prefix + name for name in expected} <= names
    assert prefix + "pc_hypre_boomeramg_stong_threshold" not in names
    assert prefix + "pc_gamg_threshold" not in names
    assert prefix + "ksp_rotl" not in names
    assert names == options.known_names()
    assert database.getAll() == before
    assert capfd.readouterr() == ("", "")


@pytest.mark.mpi
def test_known_names_survive_types_that_do_not_exist(database, capfd):
    database["tst_ksp_type"], database["tst_pc_type"] = "gmrse", "python"
    database["tst_pc_python_type"] = "no_such_module.PC"
    database["tst_sub_ksp_type"] = "cg"
    for name in database.getAll():
        database.getString(name, "")
    assert {"tst_ksp_type", "tst_pc_python_type", "tst_sub_ksp_rtol"} <= options.known_names()
    assert capfd.readouterr() == ("", "")


def test_the_closest_name_comes_first():
    names = {f"qr_pc_hypre_boomeramg_{n}" for n in ("strong_threshold", "truncfactor", "tol", "coarsen_type")}
    found = options.closest("qr_pc_hypre_boomeramg_stong_threshold", names)
    assert found[0] == "qr_pc_hypre_boomeramg_strong_threshold"
    assert len(found) <= 3
    assert options.closest("something_else", names) == []

"""Who takes part, and what is refused."""

from __future__ import annotations

import hashlib
import io
import os
import tarfile

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crazyarena.errors import InputError
from crazyarena.runner.contestant.submission import submission_hash
from crazyarena.runner.tournament import archive
from crazyarena.runner.tournament.archive import pack, unpack
from crazyarena.runner.tournament.entries import IROS, LSY, commit_of, find_entries

CONTROLLER = "class Controller:\n    def cmdFirmware(self, *a): return 0, []\n"
LSY_CONTROLLER = (
    "from lsy_drone_racing.control import Controller\nclass Mine(Controller):\n    pass\n"
)


def submission(folder, text=CONTROLLER, name="edit_this.py"):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text)
    return folder


def test_a_folder_of_folders_and_files(tmp_path):
    submission(tmp_path / "Bravo")
    submission(tmp_path / "alpha" / "competition")  # as a checkout of safe-control-gym
    (tmp_path / "charlie.py").write_text(CONTROLLER)
    submission(tmp_path / "delta", LSY_CONTROLLER, "mine.py")
    (tmp_path / "README.txt").write_text("not a team")
    (tmp_path / ".git").mkdir()
    entries = {e.name: e for e in find_entries(tmp_path)}
    assert list(entries) == ["alpha", "Bravo", "charlie", "delta"]
    assert not any(e.trouble for e in entries.values())
    assert entries["alpha"].path.name == "competition"
    assert entries["delta"].contract == LSY
    assert entries["charlie"].contract == IROS
    assert entries["charlie"].root is None


def test_one_submission_is_a_tournament_of_one(tmp_path):
    submission(tmp_path / "mine")
    assert [e.name for e in find_entries(tmp_path / "mine")] == ["mine"]
    assert [e.name for e in find_entries(tmp_path / "mine" / "edit_this.py")] == ["edit_this"]


@pytest.mark.parametrize("kind", ["csv", "yaml"])
def test_lists_with_team_names(tmp_path, kind):
    submission(tmp_path / "a")
    submission(tmp_path / "b", LSY_CONTROLLER, "mine.py")
    file = tmp_path / f"teams.{kind}"
    if kind == "csv":
        file.write_text('team,path,control_mode\n"Team Ä, Zürich",a,\nB,b,attitude\n\n')
    else:
        file.write_text(
            'teams:\n- {name: "Team Ä, Zürich", path: a}\n'
            "- {name: B, path: b, control_mode: attitude}\n"
        )
    first, second = find_entries(file)
    assert (first.name, first.slug) == ("Team Ä, Zürich", "team-a-zurich")
    assert (second.contract, second.control_mode) == (LSY, "attitude")


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("t.csv", "", "1: expected the header"),
        ("t.csv", "name,folder\n", "1: expected the header"),
        ("t.csv", "team,path\na\n", "2: expected 2 columns, found 1"),
        ("t.csv", "team,path\n,a\n", "2: team: missing"),
        ("t.csv", "team,path\n", "no teams"),
        ("t.csv", "team,path,control_mode\nA,a,rate\n", "state or attitude"),
        ("t.csv", 'team,path\n"A,a\n', "no valid CSV"),
        ("t.yaml", "teams: []", "teams"),
        ("t.yaml", "- a\n", "expected a list of teams"),
        ("t.yaml", "teams: [{name: A}]", "path: missing"),
        ("t.yaml", "teams: [{name: A, path: a, control_mode: x}]", "control_mode"),
        ("t.csv", "team,path\nA,a\na ,b\n", "two teams are called 'a' (a and b)"),
        ("t.yaml", "teams: [{name: A, path: a}, {name: 'A', path: b}]", "two teams"),
        ("t.csv", "team,path\n" + "x" * 65 + ",a\n", "1 to 64 characters"),
        ("t.txt", "", "expected a folder"),
    ],
)
def test_bad_lists_are_refused_with_their_place(tmp_path, name, text, words):
    submission(tmp_path / "a")
    submission(tmp_path / "b")
    file = tmp_path / name
    file.write_text(text)
    with pytest.raises(InputError) as error:
        find_entries(file)
    assert str(file) in str(error.value)
    assert words in str(error.value)


def test_two_names_that_look_alike_are_two_files(tmp_path):
    for name in ("Team 1", "Team-1", "team_1", "…"):
        submission(tmp_path / name)
    slugs = [e.slug for e in find_entries(tmp_path)]
    assert len(set(slugs)) == 4
    assert all(s.isascii() for s in slugs)


def test_one_that_cannot_be_read_keeps_nobody_from_flying(tmp_path):
    submission(tmp_path / "good")
    (tmp_path / "empty").mkdir()
    submission(tmp_path / "huge")
    with open(tmp_path / "huge" / "weights.bin", "wb") as stream:
        stream.truncate(1 << 40)
    submission(tmp_path / "text").joinpath("edit_this.py").write_bytes(b"\xff" * 20)
    two = submission(tmp_path / "two", LSY_CONTROLLER, "one.py")
    (two / "other.py").write_text(LSY_CONTROLLER)
    os.symlink(tmp_path / "nowhere", tmp_path / "gone.py")
    trouble = {e.name: e.trouble for e in find_entries(tmp_path)}
    assert trouble["good"] is None
    assert "no edit_this.py" in trouble["empty"]
    assert "1 TiB" in trouble["huge"]
    assert "several controllers" in trouble["two"]
    assert trouble["gone"] is not None
    assert str(tmp_path) not in "".join(filter(None, trouble.values()))


def test_nothing_to_fly_at_all(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        find_entries(tmp_path / "none")
    with pytest.raises(InputError, match="no submissions here"):
        find_entries(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no submission here can be flown"):
        find_entries(tmp_path)


# Checkouts


def test_the_commit_is_read_without_running_git(tmp_path):
    folder = submission(tmp_path / "team")
    git = folder / ".git"
    (git / "refs" / "heads").mkdir(parents=True)
    # What git would run on the way to an answer.
    (git / "config").write_text(f"[core]\n fsmonitor = touch {tmp_path}/ran\n")
    commit = "0123456789abcdef" * 2 + "01234567"
    (git / "HEAD").write_text("ref: refs/heads/main\n")
    assert commit_of(folder) is None
    (git / "packed-refs").write_text(f"# pack-refs\n{commit} refs/heads/main\n")
    assert commit_of(folder) == commit
    (git / "refs" / "heads" / "main").write_text("f" * 40 + "\n")
    assert commit_of(folder) == "f" * 40
    (git / "HEAD").write_text("e" * 40)
    assert find_entries(folder)[0].commit == "e" * 40
    for hostile in ("ref: refs/../../../../etc/passwd", "x" * 10_000_000, "ref: \x00"):
        (git / "HEAD").write_text(hostile)
        assert commit_of(folder) is None
    assert not (tmp_path / "ran").exists()


def test_a_checkout_of_lsy_flies_what_its_level_names(tmp_path):
    control = tmp_path / "team" / "lsy_drone_racing" / "control"
    submission(control, LSY_CONTROLLER, "state_controller.py")
    submission(control, LSY_CONTROLLER, "mine.py")
    config = tmp_path / "team" / "config"
    config.mkdir()
    (config / "level2.toml").write_text(
        '[controller]\nfile = "mine.py"\n[env]\ncontrol_mode = "attitude"\n'
    )
    (entry,) = find_entries(tmp_path)
    assert entry.path.name == "mine.py"
    assert entry.root.name == "lsy_drone_racing"
    assert entry.control_mode == "attitude"
    (config / "level2.toml").write_text('[controller]\nfile = "gone.py"\n')
    with pytest.raises(InputError, match=r"no gone\.py"):
        find_entries(tmp_path)


# Archives


@pytest.mark.parametrize("filters", [archive._FILTERS, False])
def test_the_same_files_make_the_same_archive(tmp_path, monkeypatch, filters):
    monkeypatch.setattr(archive, "_FILTERS", filters)
    for place in ("one", "two"):
        folder = submission(tmp_path / place / "team")
        (folder / "data").mkdir()
        (folder / "data" / "table.csv").write_text("1,2\n")
        (folder / "__pycache__").mkdir()
        (folder / "__pycache__" / "x.pyc").write_text(place)
        os.utime(folder / "edit_this.py", (len(place), len(place) * 1000))
    out = tmp_path / "out"
    out.mkdir()
    packed = [pack(find_entries(tmp_path / place)[0], out) for place in ("one", "two")]
    assert packed[0] == packed[1]
    assert [file.name for file in out.iterdir()] == [f"{packed[0][0]}.tar"]
    root = unpack(out / f"{packed[0][0]}.tar", packed[0][0], tmp_path / "kept")
    assert submission_hash(root / packed[0][1]) == submission_hash(tmp_path / "one" / "team")


@given(st.binary(max_size=200), st.binary(max_size=200))
def test_other_files_make_another(tmp_path_factory, first, second):
    tmp = tmp_path_factory.mktemp("archive")
    digests = []
    for data in (first, second):
        folder = submission(tmp / "team")
        (folder / "data.bin").write_bytes(data)
        digests.append(pack(find_entries(folder)[0], tmp)[0])
    assert (digests[0] == digests[1]) == (first == second)


@pytest.mark.parametrize("name", ["../out.txt", "/out.txt", "link"])
def test_an_old_python_extracts_nothing_elsewhere(tmp_path, monkeypatch, name):
    monkeypatch.setattr(archive, "_FILTERS", False)
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w") as stream:
        member = tarfile.TarInfo(name)
        if name == "link":
            member.type, member.linkname = tarfile.SYMTYPE, "/etc"
        stream.addfile(member, io.BytesIO())
    data = made.getvalue()
    with pytest.raises(InputError, match="not a file or folder below the submission"):
        unpack(data, hashlib.sha256(data).hexdigest(), tmp_path / "kept")


def test_nothing_of_others_comes_along(tmp_path):
    secret = tmp_path / "secret.txt"
    secret.write_text("of the organiser")
    folder = submission(tmp_path / "teams" / "thief")
    os.symlink(secret, folder / "mine.txt")
    os.symlink("/etc", folder / "etc")
    os.symlink("edit_this.py", folder / "alias.py")
    os.mkfifo(folder / "pipe")
    (tmp_path / "teams" / "other.py").write_text(CONTROLLER)
    out = tmp_path / "out"
    out.mkdir()
    for entry in find_entries(tmp_path / "teams"):
        digest, _ = pack(entry, out)
        with tarfile.open(out / f"{digest}.tar") as archive:
            names = archive.getnames()
        expected = (
            ["teams/other.py"]
            if entry.name == "other"
            else ["thief/alias.py", "thief/edit_this.py"]
        )
        assert names == expected


def test_an_archive_that_is_not_what_its_name_says(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    digest, _ = pack(find_entries(submission(tmp_path / "team"))[0], out)
    data = (out / f"{digest}.tar").read_bytes()
    with pytest.raises(InputError, match="not what its name says"):
        unpack(data + b"\0", digest, tmp_path / "kept")
    assert not list((tmp_path / "kept").glob("*"))

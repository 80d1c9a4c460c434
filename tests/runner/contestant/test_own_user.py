"""Users of contestants: one each, among those that the machine's root may become."""

import pytest

from crazyarena.runner.contestant.sandbox.own_user import own_user


@pytest.fixture
def maps(tmp_path):
    def write(*texts):
        files = [tmp_path / f"map{number}" for number in range(len(texts))]
        for file, text in zip(files, texts, strict=True):
            file.write_text(text)
        return tuple(files)

    return write


def test_no_two_have_the_same(maps):
    everybody = maps("         0          0 4294967295\n", "0 0 4294967295\n")
    given = [own_user(everybody) for _ in range(4336)]
    assert len(set(given)) == len(given)
    assert min(given) >= 61184
    assert max(given) <= 65519


def test_a_container_with_users_of_its_own(maps):
    whole = "0 100000 65536\n"
    assert 61184 <= own_user(maps(whole, whole)) <= 65519
    assert 61184 <= own_user(maps("0 1000 1\n1 100000 65535\n", whole)) <= 65519


@pytest.mark.parametrize("small", ["0 1000 1\n", "", "0 0\n", "what\n", "65534 0 1\n"])
def test_nobody_where_there_are_no_others(maps, small):
    whole = "0 100000 65536\n"
    assert own_user(maps(small, whole)) == own_user(maps(whole, small)) == 65534


def test_nobody_where_the_kernel_does_not_tell(tmp_path):
    assert own_user((tmp_path / "none",)) == 65534

"""Text of strangers does nothing but be read."""

import io
import unicodedata

from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from crazyarena.plain_text import file_name, shown, shown_in, shown_line, unmarked

anything = st.text(st.characters())  # with surrogates and control characters


@given(anything)
def test_nothing_hidden_is_left(text):
    told = shown(text)
    told.encode()
    for letter in told:
        assert letter in "\n\t" or unicodedata.category(letter) not in (
            "Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp",
        )  # fmt: skip
    assert shown(told) == told


@given(anything)
def test_a_line_is_one_line(text):
    assert len(shown_line(text).splitlines()) <= 1
    assert len(shown_line(text * 100)) < 4000


def test_ordinary_text_stays():
    text = "Überflug: 3.2 m/s, größer als 5 µs\n\tß 漢字 🚁"
    assert shown(text) is text or shown(text) == text


def test_what_a_terminal_obeys_is_escaped():
    assert shown("\x1b[2J\x9b1m\ud800\u202e\u2028\U000e0001") == (
        r"\x1b[2J\x9b1m\ud800\u202e\u2028\U000e0001"
    )
    assert shown_line("a\nb\tc\rd") == r"a\nb\tc\x0dd"


def test_plain_data():
    assert shown_in({"a\x1b": ["\x07", 1, None, ("\x00",)]}) == {
        r"a\x1b": [r"\x07", 1, None, [r"\x00"]]
    }


def test_markup_of_figures():
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure()
    canvas = FigureCanvasAgg(figure)
    figure.suptitle(unmarked("$\\frac{broken$ \x1b[2J \ud800"))
    canvas.draw()


def test_markup_of_the_terminal():
    stream = io.StringIO()
    Console(file=stream, force_terminal=False).print(shown("[bold red]markup[/]"), markup=False)
    assert stream.getvalue() == "[bold red]markup[/]\n"


@given(st.text(max_size=200))
def test_a_file_name_is_nothing_else(text):
    name = file_name(text)
    assert 0 < len(name) <= 64
    assert name == shown(name)
    assert name[0] not in ".-"
    assert not set(name) & set("/\\\0 \n\t\x1b$`'\"*?;&|<>[]~")


def test_ordinary_names_are_kept():
    assert file_name("my_controller-2.1") == "my_controller-2.1"
    assert file_name("Flieger_ä") == "Flieger_ä"
    assert file_name("../../etc/passwd") == "etc_passwd"
    assert file_name("\x1b[2J\x07") == "2J_"

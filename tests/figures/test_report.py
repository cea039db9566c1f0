import base64
import io
import subprocess
from html.parser import HTMLParser

import imageio.v2 as imageio
import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from twirl_mjx.figures import page, report, tables, wording
from twirl_mjx.figures.errors import TableError
from twirl_mjx.figures.page import Media, MediaError
from twirl_mjx.figures.statistics import Interval

ADDRESSES = ("src", "srcset", "href", "data", "poster", "action", "background")
VOID = ("meta", "link", "img", "source", "br", "input", "hr")


class Elements(HTMLParser):
    """Every start tag with its attributes, and a check that tags are closed in order."""

    def __init__(self, html):
        super().__init__()
        self.found, self.open, self.text = [], [], []
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)

    def of(self, *tags):
        return [attributes for tag, attributes in self.found if tag in tags]


@pytest.fixture(scope="module")
def html(report_file):
    return report_file.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def elements(html):
    return Elements(html)


def content(address):
    head, _, body = address.partition(",")
    assert head.endswith(";base64")
    return head.removeprefix("data:").removesuffix(";base64"), base64.b64decode(body, validate=True)


def test_no_address_leaves_the_file(html, elements):
    for tag, attributes in elements.found:
        for name in ADDRESSES:
            address = attributes.get(name)
            assert address is None or address.startswith(("data:", "#")), (tag, name, address)
    assert elements.of("script", "iframe", "object", "embed") == []
    assert "url(" not in html
    assert "@import" not in html
    (policy,) = [m["content"] for m in elements.of("meta") if "http-equiv" in m]
    assert policy.startswith("default-src 'none';")


def test_every_picture_and_clip_decodes(elements, tmp_path):
    pictures = elements.of("img")
    assert len(pictures) == 5  # return in two ways: evaluation and curves; and the clip
    for attributes in pictures:
        kind, data = content(attributes["src"])
        with Image.open(io.BytesIO(data)) as picture:
            picture.load()
            assert kind == f"image/{str(picture.format).lower()}"
            assert picture.width >= 32
    for attributes in elements.of("source"):
        with Image.open(io.BytesIO(content(attributes["srcset"])[1])) as picture:
            assert picture.convert("RGB").getpixel((1, 1)) == (22, 27, 34)
    (video,) = elements.of("video")
    kind, data = content(video["src"])
    assert kind == "video/mp4"
    (tmp_path / "clip.mp4").write_bytes(data)
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", tmp_path / "clip.mp4"]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    frames = subprocess.run(command, capture_output=True, check=True).stdout
    assert len(frames) == 5 * 48 * 64 * 3


def test_pictures_are_described_in_words_and_numbers(elements):
    descriptions = [a["alt"] for a in elements.of("img")]
    assert all(descriptions)
    assert any(d.startswith("Learning curves of return. biped: twirl ") for d in descriptions)
    assert all(a["aria-label"] for a in elements.of("video"))


def test_the_page_has_the_landmarks_of_an_accessible_one(elements):
    (root,) = elements.of("html")
    assert root["lang"] == "en"
    assert len(elements.of("h1")) == len(elements.of("main")) == len(elements.of("nav")) == 1
    assert len(elements.of("table")) == len(elements.of("caption")) >= 4
    assert all(h.get("scope") in ("col", "row") for h in elements.of("th"))
    names = {a.get("id") for _, a in elements.found}
    targets = {a["href"].removeprefix("#") for a in elements.of("a")}
    assert targets <= names
    assert {"main", "clips", "tasks", "evaluation", "terms"} <= targets


def test_rows_carry_their_commands_and_numbers(html, elements):
    assert "make sweep GRID=tasks ARGS=--only=biped-twirl" in elements.text  # stated in the file
    assert "make sweep GRID=evaluation" in elements.text  # the grid's own
    assert "make render TASK=biped" in elements.text
    assert html.count("<tr>") > 12
    text = "".join(elements.text)
    assert "Reduced: 100k of 1M transitions, 2 seeds" in text
    assert "biped: highest return " in text
    assert "(only 2 runs): twirl, 2." in text
    assert " times that of scratch" in text
    assert "source (learns nothing)" in text
    assert "episodes (1 run)" in text  # what the interval of a single policy is over


def test_the_page_is_the_same_each_time(tmp_path, write, rows_of):
    rows = rows_of("biped", "none", "twirl", 0, points=3)
    write(tmp_path / "mine" / "a.csv", tables.CURVE_COLUMNS, rows)
    first, second = (
        report.write_report(tmp_path, tmp_path / "out" / name, say=lambda line: None).read_bytes()
        for name in ("a.html", "b.html")
    )
    assert first == second


def test_names_are_escaped(tmp_path, write, rows_of):
    evil = "<script>alert('x')</script>"
    rows = [[evil, *row[1:]] for row in rows_of("biped", "none", "twirl", 0, points=2)]
    notes = [f"reduced: {evil}", f"command: echo {evil}"]
    write(tmp_path / "mine" / "a.csv", tables.CURVE_COLUMNS, rows, notes)
    path = report.write_report(tmp_path, tmp_path / "r.html", title=evil, say=lambda line: None)
    html = path.read_text(encoding="utf-8")
    assert "<script" not in html
    assert html.count("&lt;script&gt;") >= 4
    Elements(html)


def test_clips_alone_make_a_page_and_nothing_makes_none(tmp_path):
    (tmp_path / "results").mkdir()
    with pytest.raises(TableError, match="no rows and no clips, nothing to report"):
        report.write_report(tmp_path / "results", tmp_path / "r.html", say=lambda line: None)
    imageio.imwrite(tmp_path / "icy_shift.png", np.zeros((40, 40, 3), np.uint8))
    media = [tmp_path / "icy_shift.png"]
    path = report.write_report(
        tmp_path / "results", tmp_path / "r.html", media, say=lambda line: None
    )
    (picture,) = Elements(path.read_text(encoding="utf-8")).of("img")
    assert picture["alt"] == "icy shift"


def test_unusable_clips_are_refused(tmp_path):
    with pytest.raises(MediaError, match=r"a\.mp3: cannot be shown: .*nearest: '\.mp4'"):
        page.clip(Media(tmp_path / "a.mp3"))
    with pytest.raises(MediaError, match=r"a\.mp4: no such file"):
        page.clip(Media(tmp_path / "a.mp4"))
    (tmp_path / "a.mp4").write_text("version https://git-lfs.github.com/spec/v1")
    with pytest.raises(MediaError, match=r"a\.mp4: the content is not video/mp4"):
        page.clip(Media(tmp_path / "a.mp4"))


def test_a_missing_clip_is_said_before_anything_is_drawn(tmp_path, write, rows_of):
    rows = rows_of("biped", "none", "twirl", 0, points=2)
    write(tmp_path / "mine" / "a.csv", tables.CURVE_COLUMNS, rows)
    said = []
    with pytest.raises(MediaError, match=r"nope\.mp4: no such file"):
        report.write_report(tmp_path, tmp_path / "r.html", [tmp_path / "nope.mp4"], say=said.append)
    assert said == []


def test_numbers_are_written_alike():
    assert wording.interval_text(Interval(1446.4, 1317.6, 1594.0)) == "1,446 [1,318, 1,594]"
    assert wording.interval_text(Interval(0.5, 0.25, 0.75)) == "0.50 [0.25, 0.75]"
    assert wording.interval_text(Interval(12.34, float("nan"), float("nan"))) == "12.3"
    assert wording.numbers(float("nan")) == ["\N{EN DASH}"]
    assert [wording.duration(s) for s in (42.0, 1020.0, 7500.0)] == ["42 s", "17 min", "2 h 05 min"]


def test_the_main_result_opens_the_page_and_smoke_stays_out(tmp_path, write, rows_of, facts_of):
    rows = list(rows_of("biped", "none", "twirl", 0, points=2))
    for name in ("a_side", "main", "small"):
        write(tmp_path / name / "a.csv", tables.CURVE_COLUMNS, rows)
    facts_of(tmp_path / "main", place=1, title="The main result", about="Who wins.")
    facts_of(tmp_path / "small", place=0, smoke=True, title="A smoke run")
    path = report.write_report(tmp_path, tmp_path / "r.html", say=lambda line: None)
    html = path.read_text(encoding="utf-8")
    assert 0 < html.index("The main result</h2><p>Who wins.") < html.index("Grid: a_side</h2>")
    assert "A smoke run" not in html
    assert "2 grids, 2 runs." in html


def test_a_task_is_led_by_what_its_facts_say(tmp_path, write, episodes_of, facts_of):
    rows = list(episodes_of("biped", "icy", "twirl", 0))
    write(tmp_path / "mine" / "a.csv", tables.EPISODE_COLUMNS, rows)
    facts_of(tmp_path / "mine", tasks={"biped": {"lead": ["success", "return"]}})
    path = report.write_report(tmp_path, tmp_path / "r.html", say=lambda line: None)
    html = path.read_text(encoding="utf-8")
    first, more = html.split("Other measures")
    assert "<caption>Success [share]. Bold" in first
    assert '<th scope="col" class="number">Return</th>' in more

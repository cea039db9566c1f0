"""The report in a real browser, driven through Chromium's debugging pipe: no server needed."""

import pytest

MEDIA = """
(async () => {
  const images = [...document.images];
  await Promise.all(images.map(i => i.decode().catch(() => {})));
  const videos = [...document.querySelectorAll('video')];
  for (let i = 0; i < 100 && videos.some(v => v.readyState < 2 && !v.error); i++)
    await new Promise(r => setTimeout(r, 50));
  return {
    images: images.map(i => [i.naturalWidth, i.getAttribute('alt').slice(0, 40)]),
    videos: videos.map(v => [v.videoWidth, v.readyState, v.error && v.error.message]),
    background: getComputedStyle(document.body).backgroundColor,
    sources: images.map(i => i.currentSrc.length),
    overflow: document.documentElement.scrollWidth - window.innerWidth,
  };
})()
"""


@pytest.mark.timeout(180)
def test_the_report_opens_offline_in_both_colour_schemes(browser, report_file):
    seen = {}
    for scheme in ("light", "dark"):
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        browser.send("Emulation.setEmulatedMedia", features=features)
        browser.open(report_file.as_uri())
        seen[scheme] = browser.run(MEDIA)

    for page in seen.values():
        assert len(page["images"]) == 5  # two figures in two schemes, a picture
        assert all(width > 0 for width, _ in page["images"]), page["images"]
        assert all(width > 0 and ready >= 2 for width, ready, _ in page["videos"]), page["videos"]
        assert page["overflow"] <= 0
    assert seen["light"]["background"] != seen["dark"]["background"]
    assert seen["light"]["sources"] != seen["dark"]["sources"]
    assert browser.errors() == []
    urls = [e["request"]["url"] for e in browser.of("Network.requestWillBeSent")]
    assert {url.split(":")[0] for url in urls} <= {"file", "data"}
    assert [url for url in urls if url.startswith("file")] == [report_file.as_uri()] * 2


BOX = "(e => { const b = e.getBoundingClientRect(); return [b.x, b.y, b.width, b.height]; })"


@pytest.mark.timeout(180)
def test_a_figure_is_small_until_it_is_clicked_and_again_after(browser, report_file):
    browser.send(
        "Emulation.setDeviceMetricsOverride", width=1100, height=700, deviceScaleFactor=1,
        mobile=False,
    )  # fmt: skip
    browser.open(report_file.as_uri())
    browser.run(MEDIA)
    script = "[...document.querySelectorAll('.plot')].filter(f => f.checkVisibility()).map(%s)"
    boxes = browser.run(script % BOX)
    assert len(boxes) == 2  # the paper's style is folded
    assert all(200 < width < 400 and height < 260 for _, _, width, height in boxes)
    image = "document.querySelector('.plot img')"
    browser.run(f"{image}.scrollIntoView()")
    place = browser.run("window.scrollY")
    before = browser.run(BOX + f"({image})")
    click(browser, before)
    _, _, width, height = browser.run(BOX + f"({image})")
    natural = browser.run(f"[{image}.naturalWidth, {image}.naturalHeight]")
    assert [width, height] == pytest.approx(natural, abs=1)
    assert browser.run(BOX + "(document.querySelector('.plot summary'))")[3] == 700
    click(browser, (20, 20, 100, 100))  # anywhere
    assert browser.run(BOX + f"({image})") == before
    assert browser.run("window.scrollY") == place


def click(browser, box):
    at = {"x": box[0] + box[2] / 2, "y": box[1] + box[3] / 2, "button": "left", "clickCount": 1}
    for kind in ("mousePressed", "mouseReleased"):
        browser.send("Input.dispatchMouseEvent", type=kind, **at)

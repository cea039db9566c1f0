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

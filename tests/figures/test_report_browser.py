"""The report in a real browser, driven through Chromium's debugging pipe: no server needed."""

import json
import os
import select
import shutil
import subprocess
import sys
import time

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--remote-debugging-pipe",
)
# The browser reads commands from descriptor 3 and writes answers to descriptor 4.
LAUNCH = (
    "import os, sys; os.dup2(int(sys.argv[1]), 3); os.dup2(int(sys.argv[2]), 4);"
    "os.execv(sys.argv[3], sys.argv[3:])"
)
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


class Browser:
    """Just enough of the DevTools protocol: send a command, read messages up to its answer."""

    def __init__(self, executable, profile):
        to_browser, from_browser = os.pipe(), os.pipe()
        inner = [os.dup(fd) if fd < 10 else fd for fd in (to_browser[0], from_browser[1])]
        command = [sys.executable, "-c", LAUNCH, *map(str, inner), executable, *FLAGS]
        self.process = subprocess.Popen(
            [*command, f"--user-data-dir={profile}", "about:blank"],
            pass_fds=inner,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for fd in {*inner, to_browser[0], from_browser[1]}:
            os.close(fd)
        self.writer, self.reader = to_browser[1], from_browser[0]
        self.buffer, self.events, self.count, self.session = b"", [], 0, None

    def message(self, deadline):
        while b"\0" not in self.buffer:
            if not select.select([self.reader], [], [], max(0.0, deadline - time.monotonic()))[0]:
                raise TimeoutError("the browser did not answer")
            chunk = os.read(self.reader, 1 << 20)
            if not chunk:
                raise EOFError(f"the browser ended with code {self.process.wait(10)}")
            self.buffer += chunk
        text, _, self.buffer = self.buffer.partition(b"\0")
        return json.loads(text)

    def send(self, method, **params):
        self.count += 1
        request = {"id": self.count, "method": method, "params": params}
        request |= {"sessionId": self.session} if self.session else {}
        os.write(self.writer, json.dumps(request).encode() + b"\0")
        deadline = time.monotonic() + 60
        while True:
            answer = self.message(deadline)
            if answer.get("id") == self.count:
                assert "error" not in answer, answer
                return answer["result"]
            self.events.append(answer)

    def wait_for(self, event):
        deadline = time.monotonic() + 60
        while not any(e.get("method") == event for e in self.events):
            self.events.append(self.message(deadline))

    def of(self, *methods):
        return [e["params"] for e in self.events if e.get("method") in methods]

    def close(self):
        self.process.terminate()
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        os.close(self.writer)
        os.close(self.reader)


@pytest.fixture
def browser(tmp_path):
    executable = next(filter(None, map(shutil.which, NAMES)), None)
    if executable is None:
        pytest.skip(
            f"none of {', '.join(NAMES)} is installed; test_report.py checks the file itself"
        )
    browser = Browser(executable, tmp_path / "profile")
    target = browser.send("Target.createTarget", url="about:blank")["targetId"]
    attached = browser.send("Target.attachToTarget", targetId=target, flatten=True)
    browser.session = attached["sessionId"]
    yield browser
    browser.close()


@pytest.mark.timeout(180)
def test_the_report_opens_offline_in_both_colour_schemes(browser, report_file):
    for domain in ("Page", "Runtime", "Log", "Network"):
        browser.send(f"{domain}.enable")
    seen = {}
    for scheme in ("light", "dark"):
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        browser.send("Emulation.setEmulatedMedia", features=features)
        browser.events = [e for e in browser.events if e.get("method") != "Page.loadEventFired"]
        browser.send("Page.navigate", url=report_file.as_uri())
        browser.wait_for("Page.loadEventFired")
        result = browser.send(
            "Runtime.evaluate", expression=MEDIA, awaitPromise=True, returnByValue=True
        )
        seen[scheme] = result["result"]["value"]

    for page in seen.values():
        assert len(page["images"]) == 5
        assert all(width > 0 for width, _ in page["images"]), page["images"]
        assert all(width > 0 and ready >= 2 for width, ready, _ in page["videos"]), page["videos"]
        assert page["overflow"] <= 0
    assert seen["light"]["background"] != seen["dark"]["background"]
    assert seen["light"]["sources"] != seen["dark"]["sources"]
    errors = browser.of("Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded")
    assert errors == []
    urls = [e["request"]["url"] for e in browser.of("Network.requestWillBeSent")]
    assert {url.split(":")[0] for url in urls} <= {"file", "data"}
    assert [url for url in urls if url.startswith("file")] == [report_file.as_uri()] * 2

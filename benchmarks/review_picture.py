"""The picture of the review page in docs/ingest.md, from the longer sample log.

    python benchmarks/review_picture.py [--out docs/review.png] [--width 1280] [--dark]

It needs Chromium.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

from harness import run_restock
from PIL import Image

REPOSITORY = Path(__file__).parents[1]
sys.path.insert(0, str(REPOSITORY / "tests"))

from support.browser import Browser  # noqa: E402  (of the tests)
from support.served_review import ServedReview  # noqa: E402


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=REPOSITORY / "docs" / "review.png")
    parser.add_argument("--width", type=int, default=1280, help="of the window, in pixels")
    parser.add_argument("--dark", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        log = REPOSITORY / "sample_logs" / "amr_monday.mcap"
        run_restock(["ingest", str(log), "--store", str(folder / "store")])
        with ServedReview(folder / "store") as server, Browser(folder / "chromium") as browser:
            height = 844 if options.width < 700 else 840
            tab = browser.open(server.address, width=options.width, height=height)
            tab.size(options.width, height, dark=options.dark)
            tab.wait("window.review && review.moment() && true")
            for key in ".....":
                tab.press(key)
            tab.run("review.settled()")
            time.sleep(0.5)  # until it is painted
            tab.picture(folder / "shot.png")
        Image.open(folder / "shot.png").convert("RGB").quantize(64).save(options.out, optimize=True)
    print(f"wrote {options.out}: {options.out.stat().st_size:,} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())

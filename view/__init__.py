"""Web page of a skin: a heat map with contacts and time plots, live or from a recording, in any browser.

::

    with LiveSource(Skin.open("/dev/ttyACM0")) as source:
        async with serve(source) as page:
            print(page.url)
"""

from ._live import LiveSource
from ._recorded import RecordedSource
from ._server import Page, serve
from ._source import Source

__all__ = ["LiveSource", "Page", "RecordedSource", "Source", "serve"]

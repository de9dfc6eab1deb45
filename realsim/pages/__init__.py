"""One self-contained page of HTML: verdict, lead figures, tables, pictures, sliders, warnings.

A room makes a page by saying what stands on it, from top to bottom, and writes its bytes:

    page = Page(title="Scale of mug", about="session lab, 24 views")
    page.verdict("good", "Accepted.", "Use it.", [["reason one"]])        # coloured banner
    page.text("Two views have no depth.", "note")                          # warning
    page.cards([("0.21 mm", "1 sigma of the place")])                      # lead figures
    page.section("Objects", "Worst first.", key="objects")                 # heading, anchor
    page.table(["object", "verdict"], [["mug", Cell("accepted", kind="good")]])
    page.plots([(plots.png(figure), "What the plot says.")])               # side by side
    page.picture(png_or_jpeg_bytes_or_array, "What it shows.")
    page.sliders([View("view 3", {"before": rgb, "after": function_that_makes_it})])
    page.layers([View("view 3", {"photo": rgb, "depth": grey})])           # one is shown at a time
    page.sheet([View("view 3", {"": rgb})])                                # contact sheet
    write_bytes(path, page.encode())

Every text is escaped and loses the folders of this machine (`Page.plain`). The page needs neither
server nor network, works by keyboard, prints whole, and the same content gives the same bytes.
Sliders, layers and sheets share a budget: where not all views fit, views spread evenly are kept,
and the page says how many. Plots are drawn in one style with `realsim.pages.plots`.
"""

from realsim.pages.page import BUDGET_BYTES, VERDICT_KIND, Cell, Page, counted, template
from realsim.pages.pictures import Picture, View, jpeg_bytes, spread

__all__ = [
    "BUDGET_BYTES", "VERDICT_KIND", "Cell", "Page", "Picture", "View",
    "counted", "jpeg_bytes", "spread", "template",
]  # fmt: skip

"""The map of `Terrain.explore` in notebooks: the page of `publish` as a widget, fed by the kernel.

`channel` answers the questions of the page, `page_files` has what it is made of, `drawn` the window
that is drawn on it, `explorer` the widget that users hold. Needs the extra ``notebook``.
"""

"""Map of `Terrain.explore` in notebooks: the page of `publish` as a widget, fed by the kernel.

`channel` answers the page's requests, `page_files` has the page's files, `drawn` the window drawn
on it, `explorer` the widget for users. Needs the extra ``notebook``.
"""

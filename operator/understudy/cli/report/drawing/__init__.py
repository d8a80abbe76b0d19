"""How the page draws: SVG charts, HTML tables and markup.

What they show is computed beside this folder.
"""

"""Where a robot drove, by its camera that looks down (chapter 4 of the thesis).

Recordings give frames; a step between two is sought, refined and judged; steps make a track, and that layers of a map.
"""

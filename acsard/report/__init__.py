"""`acsard recording report`: turns a recording into the text of one HTML file.

All modules here are pure, except `page.drawn`, which replays the recording.

`course` processes the steps one by one and keeps the data to draw, limited as it arrives
(`acsard.core.thinning`), so a day takes no more memory than a minute. `command_sources` keeps the
data of the command sources. `account` describes the recording in words. `figures` draws it, with
the elements and the path in `drawing`. `page` assembles the file.

The plotly library's code is passed in as an argument. Text of unknown origin (names, sentences)
must always pass `page.escaped` or `drawing.label`.
"""

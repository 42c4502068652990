"""`acsard recording report`: turns a recording into the text of one HTML file.

All code of this package is pure, except the function `page.drawn`, which replays the recording.

- `report_data` collects the data to draw, step by step. It thins the data while they arrive
  (`acsard.core.thinning`), so a day takes no more memory than a minute.
- `command_sources` collects the part of these data that shows which source drove.
- `report_text` describes the recording in words.
- `figures` draws the data, with the elements of `plot_elements`.
- `page` assembles the HTML file.

The caller passes the code of the library plotly as an argument. Each text of unknown origin, such
as a name or the text of an event, must pass `page.escaped` or `plot_elements.label`.
"""

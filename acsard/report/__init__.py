"""`acsard recording report`: turns a recording into the text of one HTML file.

All code of this package is pure, except the function `page.make_report`, which reads and replays
the recording. A text of unknown origin, such as a name or the text of an event, must pass through
`page.escaped` or `plot_elements.label`. Only then may it become a part of the HTML file.
"""

"""`acsard recording report`: turns a recording into the text of one HTML file.

All code is pure, except `page.make_report`, which reads and replays the recording. A text of
unknown origin passes through `page.escaped` or `plot_elements.label` before it is in the file.
"""

"""The browser window: our own pictures, streamed as the background of a viser page (extra `viewer`).

`settings` and `session` know what is drawn, `stream` when and how large, `edits` how a moved marker goes back
into its scene file; none of them knows a browser. `server`, `controls` and `nodes` are the page.
"""

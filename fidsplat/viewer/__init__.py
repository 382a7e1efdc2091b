"""Interactive viewer: rendered images as the background of a viser page (extra `viewer`).

`settings` and `session` hold the render state, `stream` schedules images, and `scene_file` writes moved
markers to the scene file; none of them depends on a browser. `server`, `controls` and `nodes` are the page,
`guard` protects it against pages of other sites.
"""

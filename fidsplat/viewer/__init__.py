"""Interactive viewer: rendered images, streamed as the background of a viser page (extra `viewer`).

`settings` and `session` hold what is rendered, `stream` decides when and at which size, `scene_file` writes a
moved marker back to its scene file; none of them depends on a browser. `server`, `controls`, `nodes` and
`gizmo` are the page, `guard` its protection against pages of other sites.
"""

// Every fragment by its own depth, where the ray meets its splat. Lists are sorted by the nearest depth that any fragment of a
// splat can have, as blending itself rounds it (`nearest`): so nothing that is still to come lies before the splat at hand, and
// what waits nearer than that is composited, by depth, ties in the order of the list. How fragments wait is the schedule's
// (part/waiting_*.cl). There is room for WAITING at a pixel. Of more the furthest is dropped, with all that lies behind it
// (`until`), and the list is gone through again for what was dropped (`from`), until nothing is: the picture does not depend
// on WAITING.
//@ project
    record.nearest = (wide)convert_float_rtn((wide)pz - (wide)reach);
//@@ plane_nearest
//@ key
    key = (float)record.nearest;
//@ state
    Waiting waiting;
//@ start
    waiting_start(&pixel->waiting);
//@ blend_parameters
                               , global const Splat *splats, uint splat, uint place
//@ compose
//@@ compose_plane
    waiting_take(pixel, s->nearest, seen.z, opacity, splat, place, mask, splats, constants);

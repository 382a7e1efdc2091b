// Every fragment by its own depth, where the ray meets its splat. Lists are sorted by the nearest depth that any fragment of a
// splat can have, as blending itself rounds it (`nearest`): so nothing that is still to come lies before the splat at hand, and
// what waits nearer than that is composited, by depth, ties in the order of the list. How fragments wait is the schedule's
// (part/waiting_*.cl). There is room for K_BUFFER_SIZE at a pixel. Of more the furthest is dropped, with all that lies behind it
// (`until`), and the list is gone through again for what was dropped (`from`), until nothing is: the picture does not depend
// on K_BUFFER_SIZE.
//
// What is fainter than 1/255 of its splat lies no nearer and no further than the rest, whatever the cut-off: depths, and with
// them the order, are the same at every cut-off.
//@ functions
#define RANGE_RADIUS REAL(3.3290429691304455)   // sqrt(2 ln 255)
#ifndef BOX_HERE
#define BOX_HERE false
#endif
//@ depth_reach
    depth_reach = BOX_HERE ? reach : reach * (RANGE_RADIUS / radius);
//@@ coplanar_depth_reach
//@ depth_nearest
    record.nearest = (wide)convert_float_rtn(record.z_center - record.z_reach);
//@@ coplanar_nearest
//@ key
    key = (float)record.nearest;
//@ state
    KBuffer k_buffer;
//@ start
    k_buffer_start(&pixel->k_buffer);
//@ blend_parameters
                               , global const Splat *splats, uint splat, uint place, vfloat this_nearest, vfloat next_nearest
//@ compose
//@@ compose_coplanar_group
    k_buffer_insert(pixel, next_nearest, attributes.z, opacity, &attributes, splat, place, mask, splats, constants);

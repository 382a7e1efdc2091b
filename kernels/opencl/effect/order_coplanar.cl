// Splats in the order of their centres, and layers of coplanar groups. Tiles without groups do not compute depths of fragments.
//@ without_layers
    if (!pixel->layers) {
        const Attributes attributes = fragment_attributes(s, c, inverse_d);
//@@ occlude
//@@ blend_fragment
        return;
    }

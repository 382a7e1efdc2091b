// The paper's compositing formula: every fragment over what lies behind it, in depth order.
//@ compose
    composite(pixel, &attributes, opacity, mask, constants);

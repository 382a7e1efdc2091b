// The paper's compositing formula: every fragment over what lies behind it, in depth order.
//@ compose
    lay(pixel, &seen, opacity, mask, constants);

// Splats are sorted by the leading KEY_BITS bits of their depth keys; the others are 0, so that no key is that of a culled one.
//@ key_bits
    keys[i] &= 0xFFFFFFFFu << (32 - KEY_BITS);

// Pixels of one sample each are resolved by who has drawn them, and need no launch of their own.
//@ stored
        if (px < width && py + row < height) {
            const int x = px, y = py + row;
            const size_t first = at;
//@@ resolve_pixel
        }

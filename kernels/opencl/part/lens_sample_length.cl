// Length of each sample's lens ray, during resolve.
//@ resolve_sample
            float length_here = lens_ray_length(rays, channel_stride, at);

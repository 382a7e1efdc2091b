// Length of each sample's lens ray, during resolve.
//@ resolve_sample
            float length_here = length_of_ray(rays, channel_stride, at);

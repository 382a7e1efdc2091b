// The length of each sample's ray while pixels are resolved, of the ray that the lens gives it.
//@ resolve_sample
            float length_here = length_of_ray(rays, channel_stride, at);

// Groups of splats with their own motion, by label: a group's views follow those of preceding groups.
//@ splat_view
    for (int group = 0; group < moving[0]; group++)
        if (labels[i] == moving[1 + group]) view += (group + 1) * get_global_size(1);

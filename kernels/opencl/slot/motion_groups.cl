// Splats that move by themselves, by their label: each group has a view of its own, behind those of the groups before.
//@ splat_view
    for (int group = 0; group < moving[0]; group++)
        if (labels[i] == moving[1 + group]) view += (group + 1) * get_global_size(1);

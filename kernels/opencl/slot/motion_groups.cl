// Splats that move by themselves, by their label: each group has a view of its own.
//@ project_args
    , global const int *restrict group_labels   // (n)
    , global const int *restrict moving         // number of groups, words of a view, their labels
//@ splat_view
    for (int group = 0; group < moving[0]; group++)
        if (group_labels[i] == moving[2 + group]) view += (group + 1) * moving[1];

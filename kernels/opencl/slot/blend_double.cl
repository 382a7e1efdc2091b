// Records, crossings, weights and blending in double: a picture whose only rounding to float32 is that of its planes. The host
// prints double where kernels say `wide`, and draws with one lane.

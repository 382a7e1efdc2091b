// Exponential and logarithm of the device's library.
//@ arithmetic
#define EXP exp
#define LOG log

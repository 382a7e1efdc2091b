// The fragment that takes the transmittance to the stop or below is still drawn (numerics D1).

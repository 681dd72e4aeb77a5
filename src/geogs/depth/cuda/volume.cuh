// Cost volumes are (pixels, slots). A warp holds a pixel's planes, `per` consecutive ones in each
// lane; slot i * 32 + lane holds plane lane * per + i, so that lanes read side by side. Slots beyond
// the last plane hold FAR, and their entry of `slot_rho` is negative.
#pragma once

#define FAR 1e9f

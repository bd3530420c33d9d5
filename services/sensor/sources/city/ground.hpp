// What the ground looks like: carriageway with markings, kerb, pavement, grass.
#pragma once

#include "town.hpp"

namespace city {

// The parallelogram on the ground that one sample stands for.
struct GroundFootprint {
  double dx_x, dx_z, dy_x, dy_z;
};

// Colour (0..255) of the ground around (x, z), mean over the footprint.
raycast::Rgb ground_colour(const Town& town, double x, double z, const GroundFootprint& footprint);

// Factor around 1 by which stains of tens of metres and of decimetres change a colour.
float stains(const Town& town, double u_m, double v_m, const raycast::Footprint& footprint_m);

}  // namespace city

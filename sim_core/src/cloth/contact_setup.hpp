// Contact of a cloth with itself, its sheets and surfaces, set up from meshes.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "cloth/constants.hpp"
#include "cloth/mesh.hpp"
#include "cloth/numbering.hpp"
#include "contact/contact_set.hpp"
#include "contact/materials.hpp"
#include "contact/skeletons.hpp"
#include "contact/smooth.hpp"

namespace sim_core {

// Triangles that are no cloth, the surface that each of their vertices belongs to, the initial positions of these, and
// the angle from which edges of each surface are sharp, rad.
struct SurfaceMeshes {
  Triangles triangles;
  std::vector<std::int32_t> surface_of_vertex;
  Points3 positions;
  std::vector<double> crease;
};

// Side of a cell of the coarsest sheet, m.
double cell_of(const ClothMesh& mesh);
// The materials with skeletons of these bodies.
ContactMaterials with_skeletons(ContactMaterials materials, const std::vector<Skeleton>& skeletons,
                                const std::vector<Body>& bodies, double cell);

// Throws std::invalid_argument, naming the field, where the cloth would touch itself at rest.
std::unique_ptr<ContactSet> contact_set_of(const ClothMesh& mesh, const Numbering& numbering,
                                           const ContactMaterials& materials, const SurfaceMeshes& surfaces,
                                           const std::vector<Skeleton>& skeletons, const Constants& constants);
std::unique_ptr<SmoothContact> smooth_contact_of(const ClothMesh& mesh, const Numbering& numbering,
                                                 const ContactMaterials& materials, const SurfaceMeshes& surfaces,
                                                 const SmoothSettings& settings);

}  // namespace sim_core

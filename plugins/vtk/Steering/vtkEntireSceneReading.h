// SPDX-License-Identifier: MIT OR Apache-2.0
// Converts mapper, volume, property and renderer of a scene to inputs of the library.
// Functions that can fail return an error text, which is empty on success.
#ifndef vtkEntireSceneReading_h
#define vtkEntireSceneReading_h

#include "vtkSmartPointer.h"
#include "vtkType.h"

#include <entire/entire.hpp>

#include <algorithm>
#include <array>
#include <cmath>
#include <optional>
#include <string>
#include <vector>

class vtkDataArray;
class vtkImageData;
class vtkMatrix4x4;
class vtkRenderer;
class vtkVolume;
class vtkVolumeMapper;
class vtkVolumeProperty;

namespace vtkEntire
{
// Inputs from which a session's volume is read. The volume must be read again when one of these changes.
struct VolumeKey
{
  // Compared but never dereferenced, since the array may be deleted.
  const vtkDataArray* Array = nullptr;
  // MTime of the whole image: an application that changes voxels in place may call Modified() of the image only, and
  // VTK's mappers load an image again if its MTime changed.
  vtkMTimeType Time = 0;
  int Component = 0;
  std::array<int, 3> Dimensions{ { 0, 0, 0 } };
  std::array<double, 3> Spacing{ { 0, 0, 0 } };
  // First and last voxel of the cropping box along each axis.
  std::array<int, 6> Box{ { 0, -1, 0, -1, 0, -1 } };

  bool operator!=(const VolumeKey& o) const
  {
    return this->Array != o.Array || this->Time != o.Time || this->Component != o.Component ||
      this->Dimensions != o.Dimensions || this->Spacing != o.Spacing || this->Box != o.Box;
  }
};

// Inputs of a session's transfer function.
struct TransferNodes
{
  std::vector<entire_opacity_node> Opacities;
  // Empty if the volume is gray.
  std::vector<entire_color_node> Colors;
  bool Clamping = true;
  // ScalarOpacityUnitDistance.
  float Unit = 1;
  // Minimum and maximum scalar value.
  std::array<double, 2> Range{ { 0, 0 } };

  bool operator==(const TransferNodes& o) const;
};

// The voxels that a mapper draws: array, scalar type and position.
struct VoxelGrid
{
  VolumeKey Key;
  vtkDataArray* Scalars = nullptr;
  entire_scalar_type Type = 0;
  int Components = 1;
  // The center of VolumeKey::Box, as a continuous index that counts from the extent's first voxel.
  std::array<double, 3> Center{ { 0, 0, 0 } };
  // The smallest voxel spacing, which is the unit of the library's ray steps.
  double Reference = 1;
};

// Identities and MTimes of ReadGrid()'s inputs. MTimes are unique, so inputs with equal stamps have not changed.
struct GridStamp
{
  const vtkImageData* Image = nullptr;
  vtkMTimeType ImageTime = 0;
  const vtkVolumeMapper* Mapper = nullptr;
  vtkMTimeType MapperTime = 0;
  bool Independent = true;

  static GridStamp Of(vtkVolumeMapper* mapper, vtkImageData* image, vtkVolumeProperty* property);
  bool operator==(const GridStamp& o) const
  {
    return this->Image == o.Image && this->ImageTime == o.ImageTime && this->Mapper == o.Mapper &&
      this->MapperTime == o.MapperTime && this->Independent == o.Independent;
  }
};

std::string ReadGrid(
  vtkVolumeMapper* mapper, vtkImageData* image, vtkVolumeProperty* property, VoxelGrid& grid);

// Makes a volume of the voxels in the grid's box. If the library can read the voxels' type in place, the volume borrows
// the voxels: use the volume only before the scene changes, and before `kept` is released. `kept` receives a copy of
// the drawn component if its values are not stored as an ordinary array. `range` receives the minimum and maximum
// scalar value. Returns the code ENTIRE_OK on success.
entire::failure ReadVoxels(const VoxelGrid& grid, std::optional<entire::volume>& volume,
  std::array<double, 2>& range, vtkSmartPointer<vtkDataArray>& kept);

// Reads the volume property's functions of scalar opacity and color, and its ScalarOpacityUnitDistance.
void ReadTransferNodes(
  vtkVolumeProperty* property, const std::array<double, 2>& range, TransferNodes& nodes);

std::string MakeTransferFunction(
  const TransferNodes& nodes, std::optional<entire::transfer_function>& function);

// The smallest voxel spacing in world units, after the volume's matrix: the sample distance of VTK's GPU mapper with
// AutoAdjustSampleDistances.
double PlacedSpacing(vtkImageData* image, vtkVolume* volume);

// The matrix with which the renderer will draw the volume: in an assembly, a product with the assembly's matrices. While
// the assembly draws, the volume's own matrix is this product; do not call this function then, since it may build the
// assembly's paths again.
vtkMatrix4x4* DrawnMatrix(vtkRenderer* renderer, vtkVolume* volume);

// Reads the camera into `frame`, relative to the axes of a volume with the matrix `placed`, with lengths in the unit of
// the volume's spacing.
std::string ReadCamera(
  vtkRenderer* renderer, vtkMatrix4x4* placed, vtkImageData* image, const VoxelGrid& grid, entire::frame& frame);

// True if the camera changed abruptly between two frames: a component of its view direction changed by more than 0.5 (a
// turn of 29 to 51 degrees, depending on both directions), its distance (with a parallel projection, its scale) changed by a
// factor of 1.5 or more, or its projection changed. Camera.jumps_from() of the Python package has the same rule.
inline bool Jumps(const entire_frame& before, const entire_frame& now)
{
  float turned = 0;
  for (int i = 0; i < 3; ++i)
  {
    turned = std::max(turned, std::fabs(now.view[4 * i + 2] - before.view[4 * i + 2]));
  }
  if (turned > 0.5f || now.projection != before.projection)
  {
    return true;
  }
  const float ratio = now.projection == ENTIRE_PROJECTION_PARALLEL ? now.parallel_scale / before.parallel_scale
                                                                   : now.view[14] / before.view[14];
  return !(ratio > 0.67f && ratio < 1.5f);
}

// True if the renderer draws this volume, by itself or as a part of an assembly. Do not call this function while an
// assembly draws, since the assembly may delete the paths that it iterates over, and build them again.
bool IsDrawnBy(vtkRenderer* renderer, vtkVolume* volume);
}

#endif

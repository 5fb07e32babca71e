// SPDX-License-Identifier: MIT OR Apache-2.0
// Reading the scene: what a mapper, a volume, its property and a renderer are, as the library takes it.
// Functions that can fail return why they did, or an empty text.
#ifndef vtkEntireSceneReading_h
#define vtkEntireSceneReading_h

#include "vtkSmartPointer.h"
#include "vtkType.h"

#include <entire/entire.hpp>

#include <array>
#include <optional>
#include <string>
#include <vector>

class vtkDataArray;
class vtkImageData;
class vtkRenderer;
class vtkVolume;
class vtkVolumeMapper;
class vtkVolumeProperty;

namespace vtkEntire
{
// Inputs of a session's volume. Reading it again is needed when one of these changes.
struct VolumeKey
{
  // Compared only; the array may be gone.
  const vtkDataArray* Array = nullptr;
  // The MTime of the whole image: an application that changes voxels in place may modify only the image, and VTK's
  // mappers load an image again if this moved.
  vtkMTimeType Time = 0;
  int Component = 0;
  std::array<int, 3> Dimensions{ { 0, 0, 0 } };
  std::array<double, 3> Spacing{ { 0, 0, 0 } };
  // First and last voxel along each axis, those of the cropping box.
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
  // Scalar opacity's unit distance.
  float Unit = 1;
  // Range of the scalars.
  std::array<double, 2> Range{ { 0, 0 } };

  bool operator==(const TransferNodes& o) const;
};

// Position of a mapper's voxels.
struct VoxelGrid
{
  VolumeKey Key;
  vtkDataArray* Scalars = nullptr;
  entire_scalar_type Type = 0;
  int Components = 1;
  // The center of the box, as a continuous index that counts from the extent's first voxel.
  std::array<double, 3> Center{ { 0, 0, 0 } };
  // The smallest voxel spacing, in the unit of the spacing: sample distances are multiples of it.
  double Reference = 1;
};

// Time of the last change of ReadGrid()'s inputs. Times are unique, so equal stamps mean the same state.
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

// The voxels of the grid's box. The volume borrows them if the library reads their type: use it before the scene
// changes, and while `kept` lives: a copy of the drawn component, if its values are not stored as an ordinary array.
// `range` receives the minimum and maximum scalar value.
std::string ReadVoxels(const VoxelGrid& grid, std::optional<entire::volume>& volume,
  std::array<double, 2>& range, vtkSmartPointer<vtkDataArray>& kept);

// The volume property's functions of scalar opacity and color, and its ScalarOpacityUnitDistance.
void ReadTransferNodes(
  vtkVolumeProperty* property, const std::array<double, 2>& range, TransferNodes& nodes);

std::string MakeTransferFunction(
  const TransferNodes& nodes, std::optional<entire::transfer_function>& function);

// The smallest spacing of a volume after its matrix: the sample distance of VTK's GPU mapper if it adjusts by itself.
double PlacedSpacing(vtkImageData* image, vtkVolume* volume);

// The eye in the library's convention: relative to the volume's axes, lengths in the unit of the volume's spacing.
std::string ReadCamera(
  vtkRenderer* renderer, vtkVolume* volume, vtkImageData* image, const VoxelGrid& grid, entire::frame& frame);

// True if the renderer draws this volume, by itself or as a part of an assembly.
bool IsDrawnBy(vtkRenderer* renderer, vtkVolume* volume);
}

#endif

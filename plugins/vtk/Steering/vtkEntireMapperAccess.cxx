// SPDX-License-Identifier: MIT OR Apache-2.0
#include "vtkEntireMapperAccess.h"

#include "vtkFixedPointVolumeRayCastMapper.h"
#include "vtkGPUVolumeRayCastMapper.h"
#include "vtkImageData.h"
#include "vtkMultiBlockVolumeMapper.h"
#include "vtkSmartVolumeMapper.h"
#include "vtkVolumeMapper.h"

#include <map>
#include <mutex>

namespace
{
// The mappers inside vtkSmartVolumeMapper are protected: a derived class may name them.
struct SmartMembers : vtkSmartVolumeMapper
{
  static void Inner(vtkSmartVolumeMapper* smart, std::vector<vtkEntire::LeafMapper>& found)
  {
    vtkVolumeMapper* const inner[] = { smart->*&SmartMembers::GPUMapper,
      smart->*&SmartMembers::GPULowResMapper, smart->*&SmartMembers::RayCastMapper };
    for (vtkVolumeMapper* mapper : inner)
    {
      if (mapper)
      {
        found.push_back({ mapper, smart });
      }
    }
  }
};

struct SpacingMembers : vtkVolumeMapper
{
  static double Adjusted(vtkVolumeMapper* mapper, double spacing[3], int extent[6])
  {
    return (mapper->*&SpacingMembers::SpacingAdjustedSampleDistance)(spacing, extent);
  }
};

// Those of vtkMultiBlockVolumeMapper are private and nothing gives them out. An explicit instantiation may
// name private members; this one hands out the pointer to the member.
template <typename Tag, typename Tag::Type Member>
struct MemberOf
{
  friend typename Tag::Type Find(Tag) { return Member; }
};
struct BlockMappers
{
  using Type = std::vector<vtkSmartVolumeMapper*> vtkMultiBlockVolumeMapper::*;
  friend Type Find(BlockMappers);
};
template struct MemberOf<BlockMappers, &vtkMultiBlockVolumeMapper::Mappers>;

template <class Mapper>
vtkEntire::MapperSettings Of(Mapper* mapper)
{
  vtkEntire::MapperSettings settings;
  settings.SampleDistance = mapper->GetSampleDistance();
  settings.ImageSampleDistance = mapper->GetImageSampleDistance();
  settings.AutoAdjust = mapper->GetAutoAdjustSampleDistances();
  settings.Lock = mapper->GetLockSampleDistanceToInputSpacing();
  return settings;
}

template <class Mapper>
void To(Mapper* mapper, const vtkEntire::MapperSettings& settings)
{
  mapper->SetAutoAdjustSampleDistances(settings.AutoAdjust);
  mapper->SetLockSampleDistanceToInputSpacing(settings.Lock);
  mapper->SetSampleDistance(settings.SampleDistance);
  mapper->SetImageSampleDistance(settings.ImageSampleDistance);
}

template <class T>
void Keep(T& own, const T& now, const T& written)
{
  if (now != written)
  {
    own = now;
  }
}

std::mutex ClaimsMutex;
std::map<const vtkVolumeMapper*, const void*>& Claims()
{
  static std::map<const vtkVolumeMapper*, const void*> claims;
  return claims;
}
}

namespace vtkEntire
{
//------------------------------------------------------------------------------
void FindLeafMappers(vtkAbstractVolumeMapper* mapper, std::vector<LeafMapper>& found)
{
  if (auto* blocks = vtkMultiBlockVolumeMapper::SafeDownCast(mapper))
  {
    for (vtkSmartVolumeMapper* block : blocks->*Find(BlockMappers()))
    {
      FindLeafMappers(block, found);
    }
  }
  else if (auto* smart = vtkSmartVolumeMapper::SafeDownCast(mapper))
  {
    SmartMembers::Inner(smart, found);
  }
  else if (vtkFixedPointVolumeRayCastMapper::SafeDownCast(mapper) ||
    vtkGPUVolumeRayCastMapper::SafeDownCast(mapper))
  {
    found.push_back({ vtkVolumeMapper::SafeDownCast(mapper), nullptr });
  }
}

//------------------------------------------------------------------------------
double SpacingAdjustedSampleDistance(vtkVolumeMapper* mapper, vtkImageData* image)
{
  return SpacingMembers::Adjusted(mapper, image->GetSpacing(), image->GetExtent());
}

//------------------------------------------------------------------------------
MapperSettings MapperSettings::Read(vtkVolumeMapper* mapper)
{
  if (auto* gpu = vtkGPUVolumeRayCastMapper::SafeDownCast(mapper))
  {
    return Of(gpu);
  }
  return Of(vtkFixedPointVolumeRayCastMapper::SafeDownCast(mapper));
}

void MapperSettings::Write(vtkVolumeMapper* mapper) const
{
  if (auto* gpu = vtkGPUVolumeRayCastMapper::SafeDownCast(mapper))
  {
    To(gpu, *this);
  }
  else if (auto* cpu = vtkFixedPointVolumeRayCastMapper::SafeDownCast(mapper))
  {
    To(cpu, *this);
  }
}

MapperSettings MapperSettings::Keeping(const MapperSettings& now, const MapperSettings& written) const
{
  MapperSettings kept = *this;
  Keep(kept.SampleDistance, now.SampleDistance, written.SampleDistance);
  Keep(kept.ImageSampleDistance, now.ImageSampleDistance, written.ImageSampleDistance);
  Keep(kept.AutoAdjust, now.AutoAdjust, written.AutoAdjust);
  Keep(kept.Lock, now.Lock, written.Lock);
  return kept;
}

//------------------------------------------------------------------------------
SmartSettings SmartSettings::Read(vtkSmartVolumeMapper* mapper)
{
  return { mapper->GetAutoAdjustSampleDistances(), mapper->GetInteractiveAdjustSampleDistances(),
    mapper->GetSampleDistance() };
}

void SmartSettings::Write(vtkSmartVolumeMapper* mapper) const
{
  mapper->SetAutoAdjustSampleDistances(this->AutoAdjust);
  mapper->SetInteractiveAdjustSampleDistances(this->InteractiveAdjust);
  mapper->SetSampleDistance(this->SampleDistance);
}

SmartSettings SmartSettings::Keeping(const SmartSettings& now, const SmartSettings& written) const
{
  SmartSettings kept = *this;
  Keep(kept.AutoAdjust, now.AutoAdjust, written.AutoAdjust);
  Keep(kept.InteractiveAdjust, now.InteractiveAdjust, written.InteractiveAdjust);
  Keep(kept.SampleDistance, now.SampleDistance, written.SampleDistance);
  return kept;
}

//------------------------------------------------------------------------------
bool ClaimMapper(const vtkVolumeMapper* mapper, const void* who)
{
  const std::lock_guard<std::mutex> lock(ClaimsMutex);
  return Claims().emplace(mapper, who).first->second == who;
}

void ReleaseClaim(const void* who)
{
  const std::lock_guard<std::mutex> lock(ClaimsMutex);
  for (auto at = Claims().begin(); at != Claims().end();)
  {
    at = at->second == who ? Claims().erase(at) : std::next(at);
  }
}
}

// SPDX-License-Identifier: MIT OR Apache-2.0
#include <vtkEntireSteering.h>
#include <vtkNew.h>

#include <cstring>

int main()
{
  vtkNew<vtkEntireSteering> steering;
  return std::strcmp(steering->GetStatus(), "attached to nothing") == 0 ? 0 : 1;
}

// SPDX-License-Identifier: MIT OR Apache-2.0
#ifndef pqEntireSteeringPanel_h
#define pqEntireSteeringPanel_h

#include <QDockWidget>

#include <memory>

class pqView;

/**
 * A panel with the settings of the active render view's frame-time steering, and the values of its last frame.
 * Steering starts when the check box is ticked.
 */
class pqEntireSteeringPanel : public QDockWidget
{
  Q_OBJECT
  typedef QDockWidget Superclass;

public:
  pqEntireSteeringPanel(QWidget* parent = nullptr, Qt::WindowFlags flags = Qt::WindowFlags());
  ~pqEntireSteeringPanel() override;

private Q_SLOTS:
  void setView(pqView* view);
  void viewRemoved(pqView* view);
  void steer(bool on);
  void apply();
  void browse();
  void save();
  void reset();
  void readOut();

private:
  Q_DISABLE_COPY(pqEntireSteeringPanel)

  struct pqInternals;
  std::unique_ptr<pqInternals> Internals;
};

#endif
